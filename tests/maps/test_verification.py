# SPDX-License-Identifier: Apache-2.0
from pathlib import Path

import numpy as np
import pytest

from edge.errors import BadChecksum, TileError
from edge.tiles import format as tile_format
from edge.tiles.reader import open_map
from maps.verification import verify
from tests.maps.small_map import SmallMap, edited_manifest, write_small_map


@pytest.fixture
def small(tmp_path: Path) -> SmallMap:
    return write_small_map(tmp_path / "small")


def forge(small: SmallMap, name: str, array: np.ndarray) -> None:
    """Change a layer and make the manifest agree, as a faulty writer would."""
    import hashlib

    opened = open_map(small.folder)
    tile = next(tile for tile in opened.tiles if len(tile[name]))
    arrays, metadata = tile_format.decode(memoryview(tile.path.read_bytes()), "")
    arrays[name] = array.astype(arrays[name].dtype).reshape(arrays[name].shape)
    data = tile_format.encode(arrays, metadata)
    tile.path.write_bytes(data)
    with edited_manifest(small.folder) as manifest:
        (entry,) = (each for each in manifest["tiles"] if each["id"] == tile.entry.id)
        entry["sha256"] = hashlib.sha256(data).hexdigest()


def layer(small: SmallMap, name: str) -> np.ndarray:
    tiles = open_map(small.folder).tiles
    return np.array(next(tile[name] for tile in tiles if len(tile[name])))


def test_a_sound_map_is_counted(small: SmallMap) -> None:
    checked = verify(small.folder)
    assert checked.keyframes == len(small.views)
    assert checked.points == len(small.stored.xyz)
    assert checked.bytes == sum(p.stat().st_size for p in small.folder.glob("tiles/*"))


def test_a_changed_byte_is_found(small: SmallMap) -> None:
    path = open_map(small.folder).tiles[-1].path
    data = bytearray(path.read_bytes())
    data[-1] ^= 1
    path.write_bytes(data)
    with pytest.raises(BadChecksum, match=str(path)):
        verify(small.folder)


@pytest.mark.parametrize(
    ("name", "spoil"),
    [
        ("features/pixels", lambda a: np.where(a == a[0], np.nan, a)),
        ("features/point", lambda a: np.where(a == a[0], a[1], a)),
        ("features/point", lambda a: np.where(a == a[0], -1, a)),
        ("points/view_feature", lambda a: a[::-1]),
        ("points/view_feature", lambda a: a + 1000),
        ("points/view_keyframe", lambda a: a * 0 + 9999),
        ("points/sigma", lambda a: a * np.nan),
        ("covisibility/keyframe", lambda a: a * 0 + 9999),
        ("covisibility/keyframe", lambda a: a * 0),
        ("depth/inverse", lambda a: -a),
        ("depth/sigma", lambda a: a * 0),
    ],
)
def test_layers_that_disagree_are_found(small: SmallMap, name: str, spoil: object) -> None:
    forge(small, name, spoil(layer(small, name)))  # type: ignore[operator]
    with pytest.raises(TileError, match=str(small.folder)):
        verify(small.folder)


def test_words_of_another_vocabulary_are_refused(small: SmallMap) -> None:
    with edited_manifest(small.folder) as manifest:
        manifest["vocabulary"]["id"] = "0" * 64
    with pytest.raises(TileError, match="another vocabulary"):
        verify(small.folder)
