# SPDX-License-Identifier: Apache-2.0
"""Frames that never came, and cameras that jump: what is expected of the next frame then."""

import numpy as np
import pytest

from edge.geometry import se3, so3
from edge.odometry.last_motion import LastMotion
from tests.edge.odometry.drives import CORNER, SETTLED, drive, error_m, play
from tests.edge.odometry.scenes import FRAME_NS
from tests.edge.odometry.test_tracker import (
    T_WORLD_REFERENCE,
    builder,
    image_from,
    reference_of,
    track,
)

STEP = np.array([0.02, 0.0, -0.01, 0.0, 0.01, 0.005])


def moving(interval_ns: int = FRAME_NS) -> LastMotion:
    return LastMotion(
        T_WORLD_REFERENCE, se3.exp(STEP), np.zeros(2), 3.0, t_ns=0, interval_ns=interval_ns
    )


@pytest.mark.parametrize("n_missing", [4, 9])
def test_frames_that_never_came_are_no_loss(n_missing: int) -> None:
    frames = [f for f in drive() if not SETTLED + 10 <= f.index < SETTLED + 10 + n_missing]
    updates = play(frames)
    assert {u.odom_id for u in updates} == {1}
    assert all(u.T_odom_cam is not None for u in updates[SETTLED:])
    assert error_m(updates) < 6e-3


def test_the_motion_goes_on_while_frames_are_missing() -> None:
    motion = moving()
    motion.catch_up(FRAME_NS)
    np.testing.assert_allclose(motion.T_cam_last, se3.exp(STEP))
    motion.catch_up(3 * FRAME_NS + FRAME_NS // 5)  # clocks are not even
    assert motion.gap == 3
    np.testing.assert_allclose(motion.T_cam_last, se3.exp(3.0 * STEP), atol=1e-12)
    motion.catch_up(3 * FRAME_NS)
    np.testing.assert_allclose(motion.T_cam_last, se3.exp(3.0 * STEP), atol=1e-12)


def test_nobody_foretells_more_than_a_moment() -> None:
    motion = moving()
    motion.catch_up(10_000_000_000)
    assert np.linalg.norm(se3.log(motion.T_cam_last)) < 0.21e9 / FRAME_NS * np.linalg.norm(STEP)
    slow = moving(interval_ns=500_000_000)
    slow.catch_up(1_000_000_000)
    np.testing.assert_allclose(slow.T_cam_last, se3.exp(STEP), atol=1e-12)


@pytest.mark.parametrize("turn", [(0.0, 0.2, 0.0), (0.0, -0.3, 0.0), (0.15, 0.1, 0.0)])
def test_a_jump_is_found_by_a_glance(turn: tuple[float, float, float]) -> None:
    frames, motion = builder(), moving()
    reference = reference_of(CORNER, frames)
    here = image_from(CORNER, frames, np.zeros(6))
    tracked = track(frames, here, reference, np.eye(4))
    motion.remember(T_WORLD_REFERENCE, tracked, here, FRAME_NS)
    jumped = image_from(CORNER, frames, np.concatenate((np.zeros(3), turn)))
    foretold, _, glanced, *_ = motion.guesses(jumped, frames.pinholes[-1], reference)
    off = [so3.angle(T[:3, :3].T @ so3.exp(np.array(turn))) for T in (foretold, glanced)]
    assert off[0] > 0.15
    assert off[1] < 0.05
