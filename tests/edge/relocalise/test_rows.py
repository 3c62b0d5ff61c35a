# SPDX-License-Identifier: Apache-2.0
"""What a rolling shutter does to fixes in a turn."""

from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest

import edge.runtime
from edge.config.relocalise import RelocaliseConfig
from edge.relocalise import rows
from edge.relocalise.absolute_pose import solve_from
from edge.relocalise.lens import turned_rows
from edge.relocalise.relocaliser import Relocaliser
from edge.relocalise.rows import RowsEvidence
from edge.runtime.synthetic import WallDrive
from edge.tiles.reader import open_map
from edge.types import F64, U8, Frame, Query
from tests.edge.relocalise.room_matches import LENS, RoomMatches, room_matches

CONFIG = RelocaliseConfig()
WALL_MAP = Path(edge.runtime.__file__).parent / "warm_up_map"


def told(room: RoomMatches, turned_rad: F64) -> RowsEvidence:
    """What matches of a camera that turns meanwhile tell."""
    late = (room.matches.pixels[:, 1:] + 0.5) / LENS.height - 0.5
    shift = turned_rows(LENS.normalise(room.matches.pixels), turned_rad) * (LENS.fx, LENS.fy)
    matches = room.matches._replace(pixels=room.matches.pixels + late * shift)
    solution = solve_from(room.T_map_cam, matches, LENS.pinhole, CONFIG)
    assert solution is not None
    found = rows.evidence(solution, matches, LENS)
    assert found is not None
    return found


@pytest.mark.parametrize("axis", range(3))
def test_a_turn_while_rows_are_read_is_told_with_its_sign(axis: int) -> None:
    turned_rad = 0.03 * np.eye(3)[axis]
    for seed in range(4):
        found = told(room_matches(seed, n=400), turned_rad)
        assert found.chi2 > 2.0 * CONFIG.rows_chi2
        assert 0.01 < found.turned_rad[axis] < 0.05


def test_images_read_at_once_tell_no_turn() -> None:
    chi2 = [told(room_matches(seed), np.zeros(3)).chi2 for seed in range(12)]
    assert np.median(chi2) < 0.5 * CONFIG.rows_chi2


def rolled(image: U8, drive: WallDrive, turned_rad: F64) -> U8:
    """The image as rows read one after another in a turn show it."""
    height, width = image.shape
    v, u = np.mgrid[:height, :width].astype(np.float64)
    late = ((v + 0.5) / height - 0.5).ravel()[:, None]
    ideal = drive.camera.normalise(np.column_stack((u.ravel(), v.ravel())))
    from_ = drive.camera.denormalise(ideal - late * turned_rows(ideal, turned_rad))
    map_u, map_v = from_.astype(np.float32).T.reshape(2, height, width)
    return np.asarray(cv2.remap(image, map_u, map_v, cv2.INTER_LINEAR), np.uint8)


@pytest.mark.parametrize("turned_rad", [(0.0, 0.03, 0.0), (0.0, -0.02, 0.02)])
def test_a_fix_is_freed_of_the_turn_while_its_rows_were_read(
    turned_rad: tuple[float, float, float],
) -> None:
    drive = WallDrive(60)
    image = rolled(drive.image(21), drive, np.array(turned_rad))
    as_it_is = msgspec.structs.replace(CONFIG, rows_chi2=1e9)
    off_m = []
    for config in (as_it_is, CONFIG):
        relocaliser = Relocaliser(open_map(WALL_MAP), drive.camera, config)
        fix = relocaliser.step(Query(Frame(21, 0, image)))
        assert fix.T_map_cam is not None
        off_m.append(np.linalg.norm(fix.T_map_cam[:3, 3] - drive.pose(21)[:3, 3]))
    assert fix.found
    assert off_m[1] < 0.5 * off_m[0]


def test_an_image_read_at_once_stays_as_it_is() -> None:
    drive = WallDrive(60)
    poses = []
    for config in (msgspec.structs.replace(CONFIG, rows_chi2=1e9), CONFIG):
        relocaliser = Relocaliser(open_map(WALL_MAP), drive.camera, config)
        poses.append(relocaliser.step(Query(Frame(33, 0, drive.image(33)))).T_map_cam)
    np.testing.assert_array_equal(*poses)
