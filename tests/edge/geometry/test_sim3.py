# SPDX-License-Identifier: Apache-2.0
import math

import numpy as np
import pytest

from edge.geometry import se3, sim3, so3
from edge.geometry.sim3 import Sim3

TWISTS = [np.random.default_rng(seed).normal(0.0, 0.8, 7) for seed in range(6)]
TWISTS += [
    np.zeros(7),
    np.r_[1.0, -2.0, 3.0, 0.0, 0.0, 0.0, 1e-9],
    np.r_[1.0, -2.0, 3.0, 1e-9, 0.0, 0.0, 0.0],
    np.r_[1.0, -2.0, 3.0, 0.0, 3.1, 0.0, -4.0],
    np.r_[1.0, -2.0, 3.0, 0.0, 0.0, -3.1, 4.0],
]
POINTS = np.random.default_rng(7).normal(size=(9, 3))


def close(a: Sim3, b: Sim3, tolerance: float = 1e-12) -> bool:
    """Compare relative to the scale: it multiplies rounding errors too."""
    return (
        abs(math.log(a.s / b.s)) < tolerance
        and np.abs(a.R - b.R).max() < tolerance
        and float(np.abs(a.t - b.t).max()) < tolerance * max(1.0, a.s)
    )


def exponential(zeta: np.ndarray) -> np.ndarray:
    """Matrix [s R, t; 0, 1] of the generator's power series, by halving it ten times."""
    X = np.zeros((4, 4))
    X[:3, :3] = so3.hat(zeta[3:6]) + zeta[6] * np.eye(3)
    X[:3, 3] = zeta[:3]
    total = term = np.eye(4)
    for k in range(1, 20):
        term = term @ X / 1024.0 / k
        total = total + term
    return np.linalg.matrix_power(total, 1024)


@pytest.mark.parametrize("zeta", TWISTS)
def test_exp_is_the_matrix_exponential(zeta: np.ndarray) -> None:
    S = sim3.exp(zeta)
    matrix = se3.from_rotation_translation(S.s * S.R, S.t)

    assert matrix == pytest.approx(exponential(zeta), abs=1e-11 * max(1.0, S.s))


@pytest.mark.parametrize("zeta", TWISTS)
def test_log_gives_back_what_exp_took(zeta: np.ndarray) -> None:
    assert sim3.log(sim3.exp(zeta)) == pytest.approx(zeta, abs=1e-12)


@pytest.mark.parametrize("zeta", TWISTS)
def test_inverse_undoes(zeta: np.ndarray) -> None:
    S = sim3.exp(zeta)

    assert close(sim3.compose(sim3.inverse(S), S), sim3.identity())
    assert close(sim3.inverse(S), sim3.exp(-zeta))


def test_compose_applies_the_right_one_first() -> None:
    A, B = sim3.exp(TWISTS[0]), sim3.exp(TWISTS[1])
    both = sim3.transform(A, sim3.transform(B, POINTS))

    assert sim3.transform(sim3.compose(A, B), POINTS) == pytest.approx(both)


@pytest.mark.parametrize("zeta", TWISTS)
def test_adjoint_carries_a_twist_over_a_similarity(zeta: np.ndarray) -> None:
    S, step = sim3.exp(zeta), np.random.default_rng(9).normal(0.0, 0.3, 7)
    left = sim3.compose(sim3.exp(sim3.adjoint(S) @ step), S)

    assert close(left, sim3.compose(S, sim3.exp(step)), 1e-11)


@pytest.mark.parametrize("zeta", TWISTS)
def test_a_camera_sees_the_same_pixels_after_its_pose_went_over(zeta: np.ndarray) -> None:
    S, T_odom_cam = sim3.exp(zeta), se3.exp(TWISTS[3][:6])
    T_map_cam = sim3.transform_pose(S, T_odom_cam)
    in_odom = se3.transform(se3.inverse(T_odom_cam), POINTS)
    in_map = se3.transform(se3.inverse(T_map_cam), sim3.transform(S, POINTS))

    assert in_map == pytest.approx(S.s * in_odom, rel=1e-9, abs=1e-12 * max(1.0, S.s))
    assert np.linalg.det(T_map_cam[:3, :3]) == pytest.approx(1.0)


def test_the_adjoint_takes_a_step_of_the_odometry_pose_to_one_of_the_map_pose() -> None:
    S, T_odom_cam, step = sim3.exp(TWISTS[0]), se3.exp(TWISTS[1][:6]), TWISTS[2][:6]
    moved = sim3.transform_pose(S, se3.exp(step) @ T_odom_cam)
    step_map = sim3.adjoint(S)[:6, :6] @ step

    assert moved == pytest.approx(se3.exp(step_map) @ sim3.transform_pose(S, T_odom_cam))


def test_interpolation_begins_and_ends_at_its_ends() -> None:
    S0, S1 = sim3.exp(TWISTS[0]), sim3.exp(TWISTS[1])

    assert close(sim3.interpolate(S0, S1, 0.0), S0)
    assert close(sim3.interpolate(S0, S1, 1.0), S1)
    assert sim3.interpolate(S0, S1, 0.5).s == pytest.approx(math.sqrt(S0.s * S1.s))


def test_a_rigid_transform_with_a_scale_is_that_similarity() -> None:
    T = se3.exp(TWISTS[0][:6])
    S = sim3.from_se3(T, 2.5)

    assert sim3.transform(S, POINTS) == pytest.approx(2.5 * POINTS @ T[:3, :3].T + T[:3, 3])
