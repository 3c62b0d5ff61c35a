# SPDX-License-Identifier: Apache-2.0
"""Turns on the spot: nothing tells depths there, and the scale must not be made up."""

from functools import cache
from itertools import groupby

import numpy as np
import pytest

from edge.config.odometry import OdometryConfig
from edge.geometry import se3
from edge.odometry import candidates as cand
from edge.odometry.map_start import seen_from
from edge.odometry.mapper import LOW_SHARE
from edge.odometry.odometry import Odometry
from edge.types import DepthSamples, Frame, Mat4, OdometryState, OdometryUpdate
from tests.edge.odometry.drives import CORNER
from tests.edge.odometry.scenes import (
    MIDDLE,
    centres,
    frames_along,
    rmse_after_similarity,
    wandering,
)

N_WALK, N_TURN = 45, 60
STEP_RAD = 0.03
CONFIG = OdometryConfig().resolved()


@cache
def poses() -> list[Mat4]:
    """A walk, a turn on the spot with a hand's tremor, and a walk into the new direction."""
    walk = [T @ se3.exp([0, 0, 0, 0, 0.5, 0]) for T in wandering(N_WALK)]
    rng = np.random.default_rng(0)
    turn = [
        walk[-1] @ se3.exp([*(4e-4 * rng.normal(size=3)), 0, -STEP_RAD * i, 0])
        for i in range(1, N_TURN + 1)
    ]
    on = [turn[-1] @ T for T in wandering(N_WALK)]
    return [*walk, *turn, *on]


@cache
def frames() -> tuple[Frame, ...]:
    return tuple(frames_along(CORNER, MIDDLE, poses()))


def depth_at(index: int, unit: float) -> DepthSamples:
    """What a map would tell of a frame's depths, in units of `unit` metres."""
    rng = np.random.default_rng(index)
    pixels = rng.uniform((8, 8), (MIDDLE.width - 9, MIDDLE.height - 9), (300, 2))
    inverse = unit / CORNER.depth_at(MIDDLE, poses()[index], *pixels.T)
    return DepthSamples(*(a.astype(np.float32) for a in (pixels, inverse, 0.01 * inverse)))


def scales(updates: list[OdometryUpdate]) -> list[tuple[float, int]]:
    """Metres per unit of each odometry over stretches of 12 cm, with its id."""
    found = []
    tracked = [u for u in updates if u.T_odom_cam is not None]
    for odom_id, group in groupby(tracked, key=lambda u: u.odom_id):
        mine = list(group)
        a = centres([u.T_odom_cam for u in mine])
        b = centres([poses()[u.index] for u in mine])
        first = 0
        for i in range(len(mine)):
            if (moved := float(np.linalg.norm(b[i] - b[first]))) > 0.12:
                found.append((moved / float(np.linalg.norm(a[i] - a[first])), odom_id))
                first = i
    return found


def test_an_odometry_keeps_its_scale_or_ends() -> None:
    odometry = Odometry(MIDDLE)
    updates = [odometry.step(frame) for frame in frames()]
    found = scales(updates)
    assert updates[N_WALK - 1].state is OdometryState.TRACKING
    assert updates[-1].state is OdometryState.TRACKING
    for odom_id in {odom_id for _, odom_id in found}:
        of_one = [scale for scale, mine in found if mine == odom_id]
        assert max(of_one) < 1.15 * min(of_one)


def test_depths_of_a_map_carry_it_through_the_turn() -> None:
    odometry, updates = Odometry(MIDDLE), []
    unit = 0.0
    for frame in frames():
        if frame.index == N_WALK:
            unit = scales(updates)[-1][0]
        if frame.index > N_WALK and frame.index % 3 == 0:
            odometry.replenish(frame.index - 2, depth_at(frame.index - 2, unit))
        updates.append(odometry.step(frame))
    after = updates[N_WALK:]
    assert all(u.state is OdometryState.TRACKING for u in after)
    assert len({u.odom_id for u in after}) == 1
    found = [scale for scale, _ in scales(updates)]
    assert max(found) < 1.1 * min(found)
    tracked = [u for u in updates if u.T_odom_cam is not None]
    true = centres([poses()[u.index] for u in tracked])
    assert rmse_after_similarity(centres([u.T_odom_cam for u in tracked]), true) < 0.02


def test_points_seen_from_elsewhere_lie_where_they_do() -> None:
    pixels = np.array([[60.0, 50.0], [119.5, 89.5], [180.0, 120.0]], np.float32)
    here, there = poses()[0], poses()[12]
    inverse = (1.0 / CORNER.depth_at(MIDDLE, here, *pixels.T)).astype(np.float32)
    moved = seen_from(
        DepthSamples(pixels, inverse, 0.01 * inverse),
        se3.inverse(there) @ here,
        MIDDLE.pinhole,
        1.0,
    )
    true = 1.0 / CORNER.depth_at(MIDDLE, there, *moved.pixels.T)
    np.testing.assert_allclose(moved.inverse_depth, true, rtol=1e-4)
    np.testing.assert_allclose(moved.sigma / moved.inverse_depth, 0.01, rtol=0.2)


def test_points_behind_the_other_camera_are_left_out() -> None:
    pixels = np.full((1, 2), 100.0, np.float32)
    depth = DepthSamples(pixels, np.full(1, 0.5, np.float32), np.full(1, 0.01, np.float32))
    back = se3.exp([0, 0, 0, 0, np.pi, 0])
    assert len(seen_from(depth, back, MIDDLE.pinhole, 1.0).pixels) == 0


def test_a_baseline_within_its_error_tells_no_depth() -> None:
    odometry = Odometry(MIDDLE)
    for frame in frames()[:N_WALK]:
        odometry.step(frame)
    window = odometry._mapper.window
    newest = window.keyframes[-1]
    T = se3.exp([0.02, 0, 0, 0, 0, 0]) @ newest.T_cam_odom
    level = window.images[newest.slot]
    window.keyframes = [newest]
    before = newest.candidates.copy()
    cand.trace_all(window, level, T, np.zeros(2), 20.0, sigma_t=0.01)
    np.testing.assert_array_equal(newest.candidates, before)
    T_short = se3.exp([0.002, 0, 0, 0, 0, 0]) @ newest.T_cam_odom
    cand.trace_all(window, level, T_short, np.zeros(2), 20.0, sigma_t=0.0)
    np.testing.assert_array_equal(newest.candidates, before)
    cand.trace_all(window, level, T, np.zeros(2), 20.0, sigma_t=0.001)
    assert not np.array_equal(newest.candidates, before)


@pytest.mark.parametrize("share", [0.5 * LOW_SHARE, 1.1 * LOW_SHARE])
def test_a_map_helps_out_only_where_points_run_out(share: float) -> None:
    odometry = Odometry(MIDDLE)
    updates = [odometry.step(frame) for frame in frames()[:N_WALK]]
    window, wanted = odometry._mapper.window, int(share * (CONFIG.points or 0))
    keep = np.arange(window.points.shape[1]) < wanted
    window.keep_points(keep)
    odometry.replenish(N_WALK - 2, depth_at(N_WALK - 2, scales(updates)[-1][0]))
    told = int(np.count_nonzero(window.anchor[1]))
    assert (told > 0) == (share < LOW_SHARE)
    assert window.points.shape[1] == int(keep.sum()) + told
    assert np.all(window.host[window.anchor[1] > 0] == len(window.keyframes) - 1)


def test_the_same_depths_told_twice_make_points_once() -> None:
    odometry = Odometry(MIDDLE)
    updates = [odometry.step(frame) for frame in frames()[:N_WALK]]
    window = odometry._mapper.window
    window.keep_points(np.arange(window.points.shape[1]) < 40)
    depth = depth_at(N_WALK - 2, scales(updates)[-1][0])
    odometry.replenish(N_WALK - 2, depth)
    once = window.points.shape[1]
    assert once > 200
    odometry.replenish(N_WALK - 2, depth)
    assert window.points.shape[1] == once
