# SPDX-License-Identifier: Apache-2.0
import hashlib
import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from edge.errors import BadMagic, TileError
from edge.tiles import format as tile_format
from edge.tiles.reader import open_map
from tests.maps.small_map import SmallMap, edited_manifest, write_small_map


@pytest.fixture
def spoilable(tmp_path: Path) -> SmallMap:
    return write_small_map(tmp_path / "small")


def spoil_number(small: SmallMap, name: str, value: float) -> Path:
    """Put `value` in the first place of a layer of the first tile, whose path is returned."""
    path = first_tile(small)
    array = tile_format.decode(memoryview(path.read_bytes()), "")[0][name].copy()
    array.reshape(-1)[0] = value
    rewrite(path, **{name: array})
    return path


def rewrite(path: Path, **changed: np.ndarray | None) -> None:
    """Replace or take away layers of a tile, and tell the manifest of its new bytes."""
    arrays, metadata = tile_format.decode(memoryview(path.read_bytes()), str(path))
    for name, array in changed.items():
        if array is None:
            del arrays[name]
        else:
            arrays[name] = array
    data = tile_format.encode(arrays, metadata)
    path.unlink()  # an open map keeps the old file
    path.write_bytes(data)
    with edited_manifest(path.parents[1]) as table:
        (entry,) = (tile for tile in table["tiles"] if path.match(tile["path"]))
        entry |= {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}


def first_tile(small: SmallMap) -> Path:
    return small.folder / open_map(small.folder).manifest.tiles[0].path


def contents(folder: Path) -> list[np.ndarray]:
    """What a reader sees of a map."""
    opened = open_map(folder)
    seen = [opened.T_map_cam, opened.points(np.arange(opened.n_points)).xyz]
    for k in range(opened.n_keyframes):
        seen += [*opened.features(k), *opened.covisible(k), opened.depth_samples(k).pixels]
    return seen


def test_layers_of_later_versions_change_nothing(spoilable: SmallMap) -> None:
    before = contents(spoilable.folder)
    path = first_tile(spoilable)
    rewrite(
        path,
        **{
            "lines/segments": np.zeros((3, 6), np.float32),
            "lines/borders": np.array([0, 3], np.uint64),
            "learned/descriptors": np.ones((7, 64), np.float16),
            "features/sharpness": np.ones(2, np.uint8),  # beside layers that are known
            "labels/votes": np.zeros((0, 4), np.int8),
        },
    )
    with edited_manifest(spoilable.folder) as table:
        for holder in (table, table["tiles"][0], table["cameras"][0], table["vocabulary"]):
            holder["of_a_later_version"] = {"list": [1, 2.5, None]}
    after = contents(spoilable.folder)
    assert all(np.array_equal(a, b) for a, b in zip(before, after, strict=True))


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("features/pixels", np.nan),
        ("features/octave", 8),
        ("depth/pixels", np.inf),
        ("depth/inverse", 0.0),
        ("depth/sigma", np.nan),
    ],
)
def test_impossible_numbers_of_a_keyframe_are_refused_when_read(
    spoilable: SmallMap, name: str, value: float
) -> None:
    spoil_number(spoilable, name, value)
    opened = open_map(spoilable.folder)
    with pytest.raises(TileError, match=name.partition("/")[0]):
        opened.features(0) if name.startswith("features") else opened.depth_samples(0)


def test_a_missing_layer_is_named(spoilable: SmallMap) -> None:
    path = first_tile(spoilable)
    rewrite(path, **{"points/sigma": None})
    with pytest.raises(TileError, match=rf"{path}.*points/sigma"):
        open_map(spoilable.folder)


@pytest.mark.parametrize(
    ("name", "spoil"),
    [
        ("keyframes/T_map_cam", lambda a: a * 1.01),
        ("keyframes/T_map_cam", lambda a: np.where(a == 0.0, np.nan, a)),
        ("keyframes/T_map_cam", lambda a: a * [[-1.0], [-1.0], [-1.0], [1.0]]),
        ("keyframes/t_ns", lambda a: a[:-1]),
        ("keyframes/camera", lambda a: a + np.uint8(1)),
        ("features/offsets", lambda a: a[::-1].copy()),
        ("features/offsets", lambda a: a + np.uint32(1)),
        ("bow/offsets", lambda a: np.concatenate([a[:1], a[-2:0:-1], a[-1:]])),
        ("features/pixels", lambda a: a[:-1]),
        ("features/octave", lambda a: a.astype(np.int16)),
        ("points/view_offsets", lambda a: np.where(a > 0, np.uint32(0xFFFFFFFF), a)),
        ("bow/offsets", lambda a: a[:-1]),
    ],
)
def test_layers_that_do_not_fit_are_refused_when_opened(
    spoilable: SmallMap, name: str, spoil: object
) -> None:
    path = first_tile(spoilable)
    array = tile_format.decode(memoryview(path.read_bytes()), "")[0][name]
    rewrite(path, **{name: spoil(array)})  # type: ignore[operator]
    with pytest.raises(TileError, match=str(spoilable.folder)):
        open_map(spoilable.folder)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("features/point", -2_000_000_000),
        ("features/point", 2_000_000_000),
        ("points/xyz", np.nan),
        ("points/xyz", -np.inf),
        ("points/sigma", np.nan),
        ("points/sigma", np.inf),
    ],
)
def test_wild_numbers_in_a_row_are_refused_when_read(
    spoilable: SmallMap, name: str, value: float
) -> None:
    path = spoil_number(spoilable, name, value)
    opened = open_map(spoilable.folder)
    with pytest.raises(TileError, match=str(path)):
        opened.points(opened.features(0).point)


@pytest.mark.parametrize("name", ["covisibility/keyframe", "points/view_keyframe"])
def test_a_keyframe_that_is_not_there_is_refused_when_read(spoilable: SmallMap, name: str) -> None:
    path = first_tile(spoilable)
    array = tile_format.decode(memoryview(path.read_bytes()), "")[0][name]
    rewrite(path, **{name: np.full_like(array, 4_000_000_000)})
    opened = open_map(spoilable.folder)
    known = np.flatnonzero(np.diff(opened.tiles[0]["covisibility/offsets"]))
    with pytest.raises(TileError, match=str(path)):
        opened.covisible(known[0]) if name.startswith("covisibility") else opened.point_views(0)


@pytest.mark.parametrize("name", ["links/point", "links/keyframe"])
@pytest.mark.parametrize("column", [0, 1])
def test_a_link_to_nowhere_is_refused_when_followed(
    spoilable: SmallMap, name: str, column: int
) -> None:
    opened = open_map(spoilable.folder)
    tile = next(tile for tile in opened.tiles if len(tile[name]))
    k = next(k for k in range(opened.n_keyframes) if opened._locate(k)[0] == tile.entry.id)
    links = tile[name].copy()
    links[:, column] = 60_000
    rewrite(tile.path, **{name: links})
    opened = open_map(spoilable.folder)
    with pytest.raises(TileError, match=name):
        opened.features(k) if name == "links/point" else opened.covisible(k)


def test_wild_postings_are_left_out(spoilable: SmallMap) -> None:
    path = first_tile(spoilable)
    words = spoilable.descriptions[0].words
    before = open_map(spoilable.folder)
    own = before.tiles[0].entry.keyframes
    array = tile_format.decode(memoryview(path.read_bytes()), "")[0]["bow/keyframe"]
    rewrite(path, **{"bow/keyframe": np.full_like(array, own)})  # the next tile's first
    scores = open_map(spoilable.folder).bow.scores(words)
    assert scores[:own].max() == 0.0
    assert np.array_equal(scores[own:], before.bow.scores(words)[own:])


@pytest.mark.parametrize("verify", [False, True])
def test_one_flipped_bit_anywhere_is_found_when_a_small_map_opens(
    spoilable: SmallMap, verify: bool
) -> None:
    path = first_tile(spoilable)
    for spoiled in flipped(path.read_bytes()):
        path.write_bytes(spoiled)
        with pytest.raises(TileError, match=str(path)):
            open_map(spoilable.folder, verify=verify)


def test_one_flipped_bit_of_a_large_map_is_found_before_the_tile_is_used(
    spoilable: SmallMap, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("edge.tiles.reader.CHECKED_AT_ONCE_BYTES", 0)
    path = first_tile(spoilable)
    for spoiled in flipped(path.read_bytes()):
        path.write_bytes(spoiled)
        with pytest.raises(TileError, match=str(path)):
            open_map(spoilable.folder).features(0)
        with pytest.raises(TileError, match=str(path)):
            open_map(spoilable.folder).points(np.zeros(1, np.int32))


def flipped(data: bytes) -> Iterator[bytes]:
    """The bytes, one bit of them another."""
    for position in np.random.default_rng(3).integers(0, 8 * len(data), 20).tolist():
        spoiled = bytearray(data)
        spoiled[position // 8] ^= 1 << (position % 8)
        yield bytes(spoiled)


def test_a_truncated_tile_is_refused(spoilable: SmallMap) -> None:
    path = first_tile(spoilable)
    data = path.read_bytes()
    for length in (0, 4, 100, len(data) // 2, len(data) - 1):
        path.write_bytes(data[:length])
        with pytest.raises(TileError, match=rf"{path} has {length} bytes"):
            open_map(spoilable.folder)


def test_what_is_no_regular_file_is_refused_without_waiting(spoilable: SmallMap) -> None:
    path = first_tile(spoilable)
    elsewhere = path.rename(path.with_suffix(".moved"))
    with pytest.raises(TileError, match="cannot be opened"):
        open_map(spoilable.folder)
    os.mkfifo(path)
    with pytest.raises(TileError, match="no regular file"):
        open_map(spoilable.folder)
    path.unlink()
    path.symlink_to(elsewhere)
    with pytest.raises(TileError, match="cannot be opened"):
        open_map(spoilable.folder)


def test_a_folder_that_is_no_map_is_refused(tmp_path: Path) -> None:
    with pytest.raises(TileError, match="no folder"):
        open_map(tmp_path / "nowhere")
    with pytest.raises(TileError, match="no map"):
        open_map(tmp_path)
    (tmp_path / "manifest.json").write_text("{}")
    with pytest.raises(BadMagic):
        open_map(tmp_path)
    (tmp_path / "manifest.json").write_text("")
    with pytest.raises(TileError, match="empty"):
        open_map(tmp_path)
