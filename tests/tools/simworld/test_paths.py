# SPDX-License-Identifier: Apache-2.0
"""Paths: free of walls and furniture, smooth, with a hand's spectrum."""

from itertools import pairwise

import numpy as np
import pytest
from scipy.signal import welch

from edge.geometry import se3, so3
from edge.types import F64
from tests.tools.simworld.conftest import make_corner
from tools.simworld.builder import Builder
from tools.simworld.errors import WorldError
from tools.simworld.furniture import GREY, box, place
from tools.simworld.look import Look
from tools.simworld.paths import CLEARANCE_M, KINDS, make_path
from tools.simworld.rooms import make_room
from tools.simworld.tremor import HIGH_HZ, LOW_HZ, SPEED_M_S, TURN_RAD_S, Tremor
from tools.simworld.world import World

RATE_HZ = 200.0


@pytest.fixture(scope="module")
def room() -> World:
    return make_room(1)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("kind", KINDS)
def test_no_path_comes_near_anything(room: World, kind: str, seed: int) -> None:
    T = make_path(room, seed, 10.0, 60.0, kind).T_world_cam
    assert room.clearance(T[:, :3, 3]).min() > CLEARANCE_M - 0.01


@pytest.mark.parametrize("seed", range(8))
def test_path_finds_its_way_around_a_pillar(seed: int) -> None:
    b = Builder((5.0, 5.0, 2.6), 1, Look(1, paint="plain"))
    b.shell(b.look.walls(), b.look.floor(), b.look.ceiling())
    b.add("pillar", [box((0.5, 0.5, 2.6), (0, 0, 1.3), GREY)], place(0.9, 0.9, 0.0))
    world = b.world("office", 1)
    T = make_path(world, seed, 20.0).T_world_cam
    assert world.clearance(T[:, :3, 3]).min() > CLEARANCE_M - 0.01


def test_room_without_a_free_path_is_refused() -> None:
    b = Builder((3.0, 3.0, 2.6), 1, Look(1, paint="plain"))
    b.shell(b.look.walls(), b.look.floor(), b.look.ceiling())
    b.add("block", [box((2.0, 2.0, 2.6), (0, 0, 1.3), GREY)], place(0.0, 0.0, 0.0))
    with pytest.raises(WorldError, match="no free path"):
        make_path(b.world("office", 1), 1, 5.0)


def test_clearance_is_the_distance_to_the_nearest_surface() -> None:
    world = make_corner()
    points = np.array([[-1.5, -1.0, 1.2], [0.0, -1.0, 2.3], [0.0, 1.2, 0.69], [3.0, 0.0, 1.0]])
    near_wall, below_lamp, in_table_top, outside = world.clearance(points)
    assert near_wall == pytest.approx(0.5)
    assert 0.1 < below_lamp < 0.75
    assert in_table_top == 0.0
    assert outside == pytest.approx(-1.0)


def test_same_seed_gives_the_same_path_and_another_seed_another(room: World) -> None:
    a, b, c = (make_path(room, seed, 5.0).T_world_cam for seed in (3, 3, 4))
    np.testing.assert_array_equal(a, b)
    assert np.abs(a - c).max() > 0.05


def test_poses_are_rigid_and_upright(room: World) -> None:
    T = make_path(room, 1, 10.0).T_world_cam
    np.testing.assert_allclose(
        T[:, :3, :3] @ T[:, :3, :3].swapaxes(1, 2),
        np.broadcast_to(np.eye(3), (200, 3, 3)),
        atol=1e-9,
    )
    assert np.linalg.det(T[:, :3, :3]).min() == pytest.approx(1.0)
    assert T[:, 2, 1].max() < -0.8  # the image's down is the world's down


def test_still_camera_does_not_move_and_rotation_does_not_shift(room: World) -> None:
    still = make_path(room, 1, 3.0, kind="still").T_world_cam
    np.testing.assert_allclose(still, np.broadcast_to(still[0], still.shape), atol=1e-12)
    turning = make_path(room, 1, 6.0, kind="rotation").T_world_cam
    assert np.ptp(turning[:, :3, 3], axis=0).max() < 1e-12
    assert np.linalg.norm(so3.log(turning[0, :3, :3].T @ turning[-1, :3, :3])) > 1.0


def test_forward_path_looks_where_it_goes() -> None:
    world = make_room(2, "corridor")
    T = make_path(world, 1, 8.0, 20.0, "forward", tremor=0.0).T_world_cam
    step = np.diff(T[:, :3, 3], axis=0)
    ahead = T[:-1, :3, 2]
    cosine = (step * ahead).sum(axis=1) / np.linalg.norm(step, axis=1)
    assert cosine.min() > 0.9
    assert 0.9 < 20.0 * np.linalg.norm(step, axis=1).mean() < 1.6  # a walk [m/s]


def test_walk_has_a_hand_held_camera_s_speed(room: World) -> None:
    T = make_path(room, 1, 20.0, 20.0, tremor=0.0).T_world_cam
    speed = 20.0 * np.linalg.norm(np.diff(T[:, :3, 3], axis=0), axis=1)
    turns = [se3.log(se3.inverse(a) @ b)[3:] for a, b in pairwise(T)]
    rate = np.degrees(20.0 * np.linalg.norm(turns, axis=1))
    assert 0.15 < np.median(speed) < 0.6
    assert speed.max() < 1.2
    assert 5.0 < np.median(rate) < 35.0
    assert rate.max() < 80.0


def tremor_rates(seed: int) -> F64:
    shift, turn = Tremor(np.random.default_rng(seed)).at(np.arange(0.0, 60.0, 1.0 / RATE_HZ))
    return RATE_HZ * np.diff(np.hstack([shift, turn]), axis=0)


def test_tremor_has_the_rates_of_a_hand() -> None:
    rates = tremor_rates(1)
    assert rates[:, :3].std(axis=0) == pytest.approx(SPEED_M_S, rel=0.15)
    assert rates[:, 3:].std(axis=0) == pytest.approx(TURN_RAD_S, rel=0.15)


def test_tremor_lies_in_its_band_and_its_amplitude_falls() -> None:
    shift, turn = Tremor(np.random.default_rng(2)).at(np.arange(0.0, 60.0, 1.0 / RATE_HZ))
    hz, power = welch(np.hstack([shift, turn]), RATE_HZ, nperseg=2048, axis=0)
    inside = (hz > LOW_HZ - 0.3) & (hz < HIGH_HZ + 0.3)
    assert power[~inside].sum(axis=0).max() < 0.01 * power.sum(axis=0).min()
    bands = [power[(hz >= lo) & (hz < 2 * lo)].mean() for lo in (0.75, 1.5, 3.0, 6.0)]
    assert all(a > 2.0 * b for a, b in pairwise(bands))


def test_motion_has_no_jumps(room: World) -> None:
    path = make_path(room, 6, 8.0)
    T = path.at(np.arange(-0.2, 8.2, 1e-3))
    speed = np.diff(T[:, :3, 3], axis=0) / 1e-3
    assert np.abs(np.diff(speed, axis=0)).max() < 0.02  # 20 m/s^2 in a millisecond


@pytest.mark.parametrize(("kind", "seconds"), [("fly", 1.0), ("walk", 0.0)])
def test_impossible_paths_are_refused_in_one_line(room: World, kind: str, seconds: float) -> None:
    with pytest.raises(WorldError) as error:
        make_path(room, 1, seconds, kind=kind)
    assert "\n" not in str(error.value)


def test_robot_keeps_its_height_turns_on_the_spot_and_drives_straight(room: World) -> None:
    T = make_path(room, 2, 30.0, 50.0, "robot", tremor=0.0).T_world_cam
    step_m = np.linalg.norm(np.diff(T[:, :3, 3], axis=0), axis=1)
    cosine = (np.einsum("nij,nij->n", T[:-1, :3, :3], T[1:, :3, :3]) - 1.0) / 2.0
    step_deg = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
    turns, drives = (step_deg > 0.5) & (step_m < 1e-4), (step_m > 0.005) & (step_deg < 0.02)
    assert np.ptp(T[:, 2, 3]) < 1e-9
    assert turns.mean() > 0.1
    assert drives.mean() > 0.3
