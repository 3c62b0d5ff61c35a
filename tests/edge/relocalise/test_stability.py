# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from edge.config.relocalise import RelocaliseConfig
from edge.relocalise.absolute_pose import solve_from
from edge.relocalise.correspondences import Correspondences
from edge.relocalise.stability import stability
from tests.edge.relocalise.room_matches import CAMERA, room_matches

CONFIG = RelocaliseConfig()


def test_without_wrong_parts_the_spread_is_that_of_noise() -> None:
    squares = []
    for seed in range(30):
        room = room_matches(seed)
        found = solve_from(room.T_map_cam, room.matches, CAMERA, CONFIG)
        assert found is not None
        parts = stability(found.T_map_cam, room.matches, found.inlier.astype(float), CAMERA, CONFIG)
        off = found.T_map_cam[:3, 3] - room.T_map_cam[:3, 3]
        squares.append(off @ np.linalg.solve(parts.covariance[:3, :3], off) / 3.0)
    assert 0.3 < np.mean(squares) < 3.0


@pytest.mark.parametrize("shift_m", [0.5, 1.0])
def test_a_part_that_is_wrong_in_itself_widens_the_covariance(shift_m: float) -> None:
    room = room_matches(3)
    right = solve_from(room.T_map_cam, room.matches, CAMERA, CONFIG, coarse=False)
    spoilt = with_corner_moved(room.matches, shift_m)
    found = solve_from(room.T_map_cam, spoilt, CAMERA, CONFIG, coarse=False)
    assert right is not None
    assert found is not None
    off = found.T_map_cam[:3, 3] - room.T_map_cam[:3, 3]
    assert off @ np.linalg.solve(found.covariance[:3, :3], off) < 16.3  # 99.9 % of three
    assert np.linalg.norm(off) < 0.05


def with_corner_moved(matches: Correspondences, shift_m: float) -> Correspondences:
    """The points in one corner of the image, known exactly and all moved alike."""
    corner = (matches.pixels[:, 0] < CAMERA.width / 4) & (matches.pixels[:, 1] < CAMERA.height / 3)
    assert np.count_nonzero(corner) >= 3
    xyz, C = matches.xyz.copy(), matches.C.copy()
    xyz[corner] += (shift_m, 0.0, 0.0)
    C[corner] *= 1e-2
    return matches._replace(xyz=xyz, C=C)


def test_few_exact_and_wrong_matches_do_not_drag_a_good_pose_away() -> None:
    room = room_matches(5)
    xyz, C = room.matches.xyz.copy(), room.matches.C.copy()
    near = np.argsort(np.linalg.norm(xyz - room.T_map_cam[:3, 3], axis=1))[:3]
    xyz[near] += (0.6, 0.4, 0.0)
    C[near] *= 1e-3
    found = solve_from(
        room.T_map_cam, room.matches._replace(xyz=xyz, C=C), CAMERA, CONFIG, coarse=False
    )
    assert found is not None
    assert not found.inlier[near].any()
    assert np.linalg.norm(found.T_map_cam[:3, 3] - room.T_map_cam[:3, 3]) < 0.03
