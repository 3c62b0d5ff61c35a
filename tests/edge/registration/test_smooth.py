# SPDX-License-Identifier: Apache-2.0
import itertools

import numpy as np

from edge.config.registration import RegistrationConfig
from edge.geometry import se3, so3
from edge.registration.smooth import SmoothStream

CONFIG = RegistrationConfig()
STEP = se3.exp([0.01, 0.0, 0.02, 0.0, 0.01, 0.0])


def followed(correction: np.ndarray, n: int) -> tuple[SmoothStream, list[float], list[np.ndarray]]:
    """A camera that goes on by STEP; after the first frame the exact pose is corrected."""
    stream = SmoothStream(CONFIG)
    T = stream.step(np.eye(4), None)
    exact, lacks, poses = np.eye(4), [], [T]
    for k in range(n):
        exact = exact @ STEP
        if k == 0:
            exact = correction @ exact
        moved = poses[-1] @ STEP
        poses.append(stream.step(exact, STEP))
        lacks.append(float(np.linalg.norm(poses[-1][:3, 3] - moved[:3, 3])))
    return stream, [*lacks, float(np.linalg.norm(poses[-1][:3, 3] - exact[:3, 3]))], poses


def test_a_great_correction_is_taken_in_bounded_steps_and_in_full() -> None:
    stream, (*steps, left), _ = followed(se3.exp([0.2, 0.1, 0.0, 0.0, 0.0, 0.0]), 80)
    assert max(steps) <= CONFIG.smooth_step_m + 1e-12
    assert left < 1e-3
    assert stream.reset_counter == 0


def test_turns_are_bounded_too() -> None:
    _, _, poses = followed(se3.exp([0.0, 0.0, 0.0, 0.0, 0.1, 0.0]), 40)
    for a, b in itertools.pairwise(poses):
        turn = so3.angle((a @ STEP)[:3, :3].T @ b[:3, :3])
        assert turn <= np.deg2rad(CONFIG.smooth_step_deg) + 1e-9


def test_a_jump_is_counted() -> None:
    stream, (*_, left), _ = followed(se3.exp([0.8, 0.0, 0.0, 0.0, 0.0, 0.0]), 3)
    assert stream.reset_counter == 1
    assert left < 1e-9


def test_a_gap_starts_anew_and_is_counted() -> None:
    stream = SmoothStream(CONFIG)
    stream.step(np.eye(4), None)
    assert stream.reset_counter == 0
    stream.interrupt()
    T = se3.exp([0.1, 0.0, 0.0, 0.0, 0.0, 0.0])
    np.testing.assert_array_equal(stream.step(T, STEP), T)
    assert stream.reset_counter == 1
