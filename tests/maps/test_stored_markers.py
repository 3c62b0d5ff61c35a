# SPDX-License-Identifier: Apache-2.0
from pathlib import Path

import msgspec
import numpy as np
import pytest

from edge.config import Config
from edge.config.markers import MarkersConfig
from edge.errors import TileError
from edge.runtime.finding import make_finder
from edge.tiles.manifest import FILE_NAME, MarkerEntry, decode, encode
from edge.tiles.reader import open_map
from edge.types import Query
from maps.build import BuildInput, build
from maps.merge import merge
from maps.settings import BuildSettings
from tests.edge.relocalise.marked_drive import NUMBER, SIDE_M, T_MAP_MARKER, frames
from tests.maps.drive_folder import KnownView, write_drive
from tests.maps.wall_drive import CAMERA


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("marked")
    images, poses = frames(24)
    shown = (KnownView(images[k].image, poses[k]) for k in range(0, 24, 6))
    drive = write_drive(folder / "drive", CAMERA, shown, first_s=1.0)
    settings = BuildSettings(markers="4X4_50", similar_views=3)
    build(BuildInput([drive]), folder / "map", settings)
    return folder / "map"


def test_markers_are_stored_where_they_hang(built: Path) -> None:
    (marker,) = open_map(built).manifest.markers
    assert (marker.family, marker.number) == ("4X4_50", NUMBER)
    assert marker.side == pytest.approx(SIDE_M, rel=0.01)
    T = np.array(marker.T_map_marker)
    assert np.allclose(T[:3, 3], T_MAP_MARKER[:3, 3], atol=0.01)
    assert np.allclose(T[:3, :3], T_MAP_MARKER[:3, :3], atol=0.05)


def test_a_stored_marker_tells_the_pose_without_any_setting(built: Path) -> None:
    images, poses = frames(8)
    finder = make_finder(Config(), CAMERA, open_map(built))
    assert finder is not None
    for k in (1, 4, 7):
        fix = finder.step(Query(images[k]))
        assert fix.found
        assert fix.T_map_cam is not None
        assert np.linalg.norm(fix.T_map_cam[:3, 3] - poses[k][:3, 3]) < 0.03
        assert fix.inliers == 4
    off = msgspec.structs.replace(Config(), markers=MarkersConfig(in_map=False))
    finder = make_finder(off, CAMERA, open_map(built))
    assert finder is not None
    assert finder.step(Query(images[1])).inliers != 4


def test_two_maps_in_one_keep_each_marker_once(built: Path, tmp_path: Path) -> None:
    merge(built, built, tmp_path / "both")
    assert open_map(tmp_path / "both").manifest.markers == open_map(built).manifest.markers


@pytest.mark.parametrize(
    ("row", "column", "value"), [(0, 0, 1.1), (3, 3, 2.0), (1, 3, 1e12), (0, 1, float("nan"))]
)
def test_places_that_cannot_be_are_refused(
    built: Path, row: int, column: int, value: float
) -> None:
    manifest = open_map(built).manifest
    rows = np.array(manifest.markers[0].T_map_marker)
    rows[row, column] = value
    table = {**msgspec.structs.asdict(manifest.markers[0]), "T_map_marker": rows.tolist()}
    spoilt = msgspec.structs.replace(manifest, markers=[msgspec.convert(table, MarkerEntry)])
    with pytest.raises(TileError):
        decode(encode(spoilt), built / FILE_NAME)
