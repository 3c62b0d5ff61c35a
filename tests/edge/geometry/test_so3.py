# SPDX-License-Identifier: Apache-2.0
import math

import numpy as np
import pytest

from edge.geometry import so3

# Both sides of every switch between series and closed form, and the ends.
ANGLES = [0.0, 1e-300, 1e-12, 1e-6, 0.2999, 0.3001, 1.0, 3.0, math.pi - 1e-9, math.pi]


def turn(angle: float, seed: int = 0) -> np.ndarray:
    axis = np.random.default_rng(seed).normal(size=3)
    return angle * axis / np.linalg.norm(axis)


def series(w: np.ndarray, first: int) -> np.ndarray:
    """Sum of hat(w)^k / (k + first)!: exp for first = 0, the left Jacobian for 1."""
    term = np.eye(3) / math.factorial(first)
    total = term
    for k in range(1, 60):
        term = term @ so3.hat(w) / (k + first)
        total = total + term
    return total


@pytest.mark.parametrize("angle", ANGLES)
def test_exp_is_the_matrix_exponential(angle: float) -> None:
    assert so3.exp(turn(angle)) == pytest.approx(series(turn(angle), 0), abs=1e-14)


@pytest.mark.parametrize("angle", ANGLES)
def test_left_jacobian_is_its_power_series(angle: float) -> None:
    assert so3.left_jacobian(turn(angle)) == pytest.approx(series(turn(angle), 1), abs=1e-14)


@pytest.mark.parametrize("angle", ANGLES)
def test_left_jacobian_inverse_is_the_inverse(angle: float) -> None:
    product = so3.left_jacobian(turn(angle)) @ so3.left_jacobian_inverse(turn(angle))

    assert product == pytest.approx(np.eye(3), abs=1e-14)


@pytest.mark.parametrize("angle", ANGLES[:-1])
@pytest.mark.parametrize("seed", range(6))
def test_log_gives_back_what_exp_took(angle: float, seed: int) -> None:
    w = turn(angle, seed)

    assert so3.log(so3.exp(w)) == pytest.approx(w, rel=1e-9, abs=1e-14)


@pytest.mark.parametrize("axis", [*np.eye(3), [0.6, 0.0, -0.8], [-0.6, 0.48, 0.64]])
def test_log_of_a_half_turn_is_a_half_turn(axis: list[float]) -> None:
    R = 2.0 * np.outer(axis, axis) - np.eye(3)
    w = so3.log(R)

    assert np.linalg.norm(w) == pytest.approx(math.pi)
    assert so3.exp(w) == pytest.approx(R, abs=1e-15)


def test_hat_is_the_cross_product() -> None:
    w, p = np.random.default_rng(1).normal(size=(2, 3))

    assert so3.hat(w) @ p == pytest.approx(np.cross(w, p))


@pytest.mark.parametrize("seed", range(20))
def test_quaternion_and_matrix_agree_with_rotating_by_conjugation(seed: int) -> None:
    rng = np.random.default_rng(seed)
    q = rng.normal(size=4)
    q /= np.linalg.norm(q)
    p = rng.normal(size=3)
    v, w = q[:3], q[3]
    rotated = p + 2.0 * np.cross(v, np.cross(v, p) + w * p)

    assert so3.from_quaternion_xyzw(q) @ p == pytest.approx(rotated)
    assert so3.from_quaternion_xyzw(3.0 * q) @ p == pytest.approx(rotated)
    assert so3.to_quaternion_xyzw(so3.from_quaternion_xyzw(q)) == pytest.approx(
        q if w >= 0 else -q, abs=1e-14
    )


def test_many_quaternions_at_once_are_each_alone() -> None:
    q = np.random.default_rng(2).normal(size=(5, 4))

    for each, R in zip(q, so3.from_quaternion_xyzw(q), strict=True):
        assert np.array_equal(so3.from_quaternion_xyzw(each), R)


def test_normalise_gives_the_nearest_rotation() -> None:
    rng = np.random.default_rng(3)
    R = so3.exp(turn(1.0))
    bent = R + rng.normal(0.0, 1e-3, (3, 3))
    mended = so3.normalise(bent)

    assert mended @ mended.T == pytest.approx(np.eye(3), abs=1e-14)
    assert np.linalg.det(mended) == pytest.approx(1.0)
    for _ in range(20):
        other = so3.exp(rng.normal(0.0, 1e-3, 3)) @ mended
        assert np.linalg.norm(mended - bent) <= np.linalg.norm(other - bent)


def test_normalise_of_a_reflection_is_a_rotation() -> None:
    assert np.linalg.det(so3.normalise(np.diag([1.0, 1.0, -1.0]))) == pytest.approx(1.0)
