# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from edge.geometry import se3, so3

TWISTS = [np.random.default_rng(seed).normal(0.0, 0.8, 6) for seed in range(6)]
TWISTS += [np.zeros(6), np.r_[1.0, -2.0, 3.0, 0.0, 0.0, 0.0], np.r_[0.0, 0.0, 0.0, 1e-9, 0.0, 0.0]]
# The coupling block of the Jacobian changes from series to closed form at 0.5 rad.
TWISTS += [np.r_[1.0, -2.0, 3.0, 0.0, 0.4999, 0.0], np.r_[1.0, -2.0, 3.0, 0.0, 0.5001, 0.0]]


def exponential(xi: np.ndarray) -> np.ndarray:
    """Power series of the twist's 4x4 generator, by halving it ten times."""
    X = np.zeros((4, 4))
    X[:3, :3], X[:3, 3] = so3.hat(xi[3:]), xi[:3]
    total = term = np.eye(4)
    for k in range(1, 20):
        term = term @ X / 1024.0 / k
        total = total + term
    return np.linalg.matrix_power(total, 1024)


@pytest.mark.parametrize("xi", TWISTS)
def test_exp_is_the_matrix_exponential(xi: np.ndarray) -> None:
    assert se3.exp(xi) == pytest.approx(exponential(xi), abs=1e-12)


@pytest.mark.parametrize("xi", TWISTS)
def test_log_gives_back_what_exp_took(xi: np.ndarray) -> None:
    assert se3.log(se3.exp(xi)) == pytest.approx(xi, abs=1e-13)


@pytest.mark.parametrize("xi", TWISTS)
def test_inverse_undoes(xi: np.ndarray) -> None:
    T = se3.exp(xi)

    assert se3.inverse(T) @ T == pytest.approx(np.eye(4), abs=1e-14)
    assert se3.inverse(T) == pytest.approx(se3.exp(-xi), abs=1e-14)


@pytest.mark.parametrize("xi", TWISTS)
def test_adjoint_carries_a_twist_over_a_transform(xi: np.ndarray) -> None:
    T, step = se3.exp(xi), np.random.default_rng(9).normal(0.0, 0.5, 6)

    moved = se3.exp(se3.adjoint(T) @ step) @ T
    assert moved == pytest.approx(T @ se3.exp(step), abs=1e-13)


def test_adjoint_of_a_product_is_the_product_of_adjoints() -> None:
    A, B = se3.exp(TWISTS[0]), se3.exp(TWISTS[1])

    assert se3.adjoint(A @ B) == pytest.approx(se3.adjoint(A) @ se3.adjoint(B))


@pytest.mark.parametrize("axis", range(6), ids=["tx", "ty", "tz", "rx", "ry", "rz"])
@pytest.mark.parametrize("xi", TWISTS)
def test_left_jacobian_is_the_slope_of_exp(xi: np.ndarray, axis: int) -> None:
    step = np.zeros(6)
    step[axis] = 1e-5  # truncation and rounding both near 1e-10
    inverse = se3.inverse(se3.exp(xi))
    rise = se3.log(se3.exp(xi + step) @ inverse) - se3.log(se3.exp(xi - step) @ inverse)

    assert se3.left_jacobian(xi)[:, axis] == pytest.approx(rise / 2e-5, abs=1e-8)


@pytest.mark.parametrize("xi", TWISTS)
def test_left_jacobian_is_its_power_series(xi: np.ndarray) -> None:
    ad = np.zeros((6, 6))
    ad[:3, :3] = ad[3:, 3:] = so3.hat(xi[3:])
    ad[:3, 3:] = so3.hat(xi[:3])
    total = term = np.eye(6)
    for k in range(2, 40):
        term = term @ ad / k
        total = total + term

    assert se3.left_jacobian(xi) == pytest.approx(total, abs=1e-12)


@pytest.mark.parametrize("xi", TWISTS)
def test_left_jacobian_inverse_is_the_inverse(xi: np.ndarray) -> None:
    product = se3.left_jacobian(xi) @ se3.left_jacobian_inverse(xi)

    assert product == pytest.approx(np.eye(6), abs=1e-13)


def test_interpolation_begins_and_ends_at_its_ends() -> None:
    T0, T1 = se3.exp(TWISTS[0]), se3.exp(TWISTS[1])

    assert se3.interpolate(T0, T1, 0.0) == pytest.approx(T0, abs=1e-14)
    assert se3.interpolate(T0, T1, 1.0) == pytest.approx(T1, abs=1e-14)


def test_interpolation_is_steady_and_the_same_from_either_end() -> None:
    T0, T1 = se3.exp(TWISTS[0]), se3.exp(TWISTS[1])
    half = se3.interpolate(T0, T1, 0.5)

    assert half == pytest.approx(se3.interpolate(T1, T0, 0.5), abs=1e-13)
    assert half @ se3.inverse(T0) == pytest.approx(T1 @ se3.inverse(half), abs=1e-13)


def test_transform_moves_points_as_the_matrix_does() -> None:
    T = se3.exp(TWISTS[2])
    points = np.random.default_rng(4).normal(size=(7, 3))
    homogeneous = np.column_stack((points, np.ones(7)))

    assert se3.transform(T, points) == pytest.approx((homogeneous @ T.T)[:, :3])


@pytest.mark.parametrize("xi", TWISTS)
def test_a_tum_row_gives_back_its_transform(xi: np.ndarray) -> None:
    T = se3.exp(xi)
    row = se3.to_tum(T)

    assert row[:3] == pytest.approx(T[:3, 3])
    assert row[6] >= 0.0
    assert se3.from_tum(row) == pytest.approx(T, abs=1e-14)


def test_normalise_mends_a_thousand_products() -> None:
    T = np.eye(4)
    for xi in TWISTS[:5] * 200:
        T = T.astype(np.float32).astype(np.float64) @ se3.exp(xi)
    R = se3.normalise(T)[:3, :3]
    error = np.abs(R @ R.T - np.eye(3)).max()

    assert np.abs(T[:3, :3] @ T[:3, :3].T - np.eye(3)).max() > 1e-8
    assert error < 1e-14
