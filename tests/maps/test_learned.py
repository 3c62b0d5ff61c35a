# SPDX-License-Identifier: Apache-2.0
from pathlib import Path

import numpy as np
import pytest

from edge.config.relocalise import RelocaliseConfig
from edge.errors import ConfigError, TileError
from edge.runtime.learned import make_relocaliser
from edge.tiles.learned import LearnedMap
from edge.tiles.reader import open_map
from edge.types import Frame, Query
from maps.build import BuildInput, build
from maps.merge import merge
from maps.settings import BuildSettings
from maps.thin import thin
from maps.verification import verify
from tests.maps.small_map import edited_manifest
from tests.maps.wall_drive import CAMERA, picture, poses, wall, write_wall_drive
from tools.corner_model import make

N = 6


class Built:
    """Maps of one wall with and without the features of a model."""

    def __init__(self, folder: Path) -> None:
        self.drive = write_wall_drive(folder / "wall", N)
        self.model = make(folder / "corners.onnx")
        self.plain, self.both, self.second = (folder / n for n in ("plain", "both", "second"))
        source = BuildInput([self.drive], exclude=frozenset({2}))
        build(source, self.plain, BuildSettings())
        build(source, self.both, BuildSettings(), features=self.model)
        build(BuildInput([self.drive], slice(2, 5)), self.second, BuildSettings(),
              features=self.model)  # fmt: skip


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Built:
    return Built(tmp_path_factory.mktemp("learned"))


def query(number: int) -> Query:
    return Query(Frame(number, 0, picture(wall(), poses(N)[number])))


def off_m(folder: Path, model: Path, number: int) -> float:
    relocaliser = make_relocaliser(open_map(folder), CAMERA, RelocaliseConfig(features=str(model)))
    fix = relocaliser.step(query(number))
    assert fix.reason == "ok"
    assert fix.T_map_cam is not None
    return float(np.linalg.norm(fix.T_map_cam[:3, 3] - poses(N)[number][:3, 3]))


def test_a_view_that_is_not_in_the_map_is_found_by_the_model(built: Built) -> None:
    assert off_m(built.both, built.model, 2) < 0.02


def test_the_layer_changes_nothing_of_the_map_for_others(built: Built) -> None:
    plain, both = open_map(built.plain), open_map(built.both)
    assert [t.sha256 for t in plain.manifest.tiles] == [t.sha256 for t in both.manifest.tiles]
    assert both.manifest.learned is not None
    assert {Path(file.path).name for file in both.manifest.files()} == {
        path.name for path in (built.both / "tiles").iterdir()
    }
    learned = LearnedMap(both)
    np.testing.assert_array_equal(learned.T_map_cam, both.T_map_cam)
    assert learned.n_points > 300


def test_the_model_of_the_map_is_asked_for(built: Built, tmp_path: Path) -> None:
    other = make(tmp_path / "other.onnx", points=(300, 320, 224))
    with pytest.raises(
        ConfigError, match=r"both was built with corners.onnx \(sha256 [0-9a-f]{12}"
    ):
        off_m(built.both, other, 2)
    with pytest.raises(ConfigError, match="none but ORB's"):
        off_m(built.plain, built.model, 2)


def test_every_byte_of_the_layer_is_verified(built: Built, tmp_path: Path) -> None:
    thin(built.both, tmp_path / "copy", 1.1, 1)
    verify(tmp_path / "copy")
    tile = tmp_path / "copy" / LearnedMap(open_map(tmp_path / "copy")).manifest.tiles[0].path
    data = bytearray(tile.read_bytes())
    data[len(data) // 2] ^= 1
    tile.write_bytes(data)
    with pytest.raises(TileError, match="learned_"):
        verify(tmp_path / "copy")


def test_thinned_and_merged_maps_keep_it(built: Built, tmp_path: Path) -> None:
    thinned = thin(built.both, tmp_path / "thin", 0.5, 1)
    assert thinned.counts.keyframes < N - 1
    assert thinned.learned is not None
    assert thinned.learned.counts.keyframes == thinned.counts.keyframes
    merged, _ = merge(built.both, built.second, tmp_path / "merged")
    assert merged.learned is not None
    assert merged.learned.counts.keyframes == merged.counts.keyframes == N - 1 + 3
    assert off_m(tmp_path / "merged", built.model, 2) < 0.02


def test_a_vocabulary_of_another_map_is_refused(built: Built, tmp_path: Path) -> None:
    thin(built.both, tmp_path / "copy", 1.1, 1)
    with edited_manifest(tmp_path / "copy") as manifest:
        manifest["learned"]["vocabulary"]["sha256"] = "0" * 64
    with pytest.raises(TileError, match="another vocabulary"):
        off_m(tmp_path / "copy", built.model, 2)
