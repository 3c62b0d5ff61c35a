# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from edge.config.relocalise import RelocaliseConfig
from edge.relocalise.absolute_pose import solve_from
from edge.relocalise.correspondences import Correspondences
from edge.relocalise.focal import focal_error
from edge.types import Mat4, Pinhole
from tests.edge.relocalise.room_matches import CAMERA, room_matches

CONFIG = RelocaliseConfig()


def error(matches: Correspondences, T_start: Mat4, camera: Pinhole) -> float:
    found = solve_from(T_start, matches, camera, CONFIG)
    assert found is not None
    return focal_error(found, matches, camera)


def longer(share: float) -> Pinhole:
    return CAMERA._replace(fx=CAMERA.fx * (1.0 + share), fy=CAMERA.fy * (1.0 + share))


@pytest.mark.parametrize("seed", range(10))
def test_a_right_focal_length_is_never_refused(seed: int) -> None:
    room = room_matches(seed, n=60, wrong_share=0.2)
    assert abs(error(room.matches, room.T_map_cam, CAMERA)) < 0.5 * CONFIG.max_focal_error


@pytest.mark.parametrize("share", [-0.1, -0.05, 0.05, 0.1])
def test_a_wrong_focal_length_is_told_with_its_sign(share: float) -> None:
    for seed in range(4):
        room = room_matches(seed)
        told = error(room.matches, room.T_map_cam, longer(share))
        assert told * -share > 0.0
        assert abs(told) > CONFIG.max_focal_error


def test_a_wall_seen_straight_tells_no_focal_length() -> None:
    rng = np.random.default_rng(0)
    matches = room_matches(0).matches
    xyz = np.column_stack((rng.uniform(-0.8, 0.8, (200, 2)), np.full(200, 2.0)))
    pixels = xyz[:, :2] / 2.0 * (CAMERA.fx, CAMERA.fy) + (CAMERA.cx, CAMERA.cy)
    wall = matches._replace(xyz=xyz, pixels=pixels + 0.5 * rng.normal(size=(200, 2)))
    assert abs(error(wall, np.eye(4), longer(0.05))) < CONFIG.max_focal_error
