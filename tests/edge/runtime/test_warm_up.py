# SPDX-License-Identifier: Apache-2.0
from edge.relocalise.bow import shipped_vocabulary
from edge.runtime.synthetic import CAMERA, WallDrive
from edge.runtime.warm_lines import warm_lines
from edge.runtime.warm_plain import warm_plain
from edge.runtime.warm_up import DRIVE_FRAMES, MAP_FOLDER
from edge.tiles.reader import open_map

REMEDY = "the map format or the vocabulary has changed: run `python -m tools.make_warm_up_map`"


def test_shipped_map_fits_the_shipped_vocabulary() -> None:
    map_ = open_map(MAP_FOLDER, verify=True)
    assert map_.manifest.vocabulary.id == shipped_vocabulary().id, REMEDY


def test_shipped_map_is_of_the_drive() -> None:
    map_ = open_map(MAP_FOLDER)
    drive = WallDrive(DRIVE_FRAMES)
    for k in range(map_.n_keyframes):
        index = round(int(map_.keyframe_t_ns[k]) * 1e-9 * drive.rate_hz)
        assert abs(map_.T_map_cam[k] - drive.pose(index)).max() < 1e-6


def test_lines_are_warmed_up_by_telling_a_pose() -> None:
    assert warm_lines(CAMERA)


def test_plain_rooms_are_warmed_up_by_finding_lines() -> None:
    assert warm_plain(CAMERA) >= 4


def test_drive_looks_the_same_each_time() -> None:
    assert (WallDrive(1).image(0) == WallDrive(1).image(0)).all()
