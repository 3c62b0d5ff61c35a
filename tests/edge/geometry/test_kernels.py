# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from edge.geometry import se3
from edge.geometry.kernels import exp_times, solve_symmetric


@pytest.mark.parametrize("angle_rad", [0.0, 1e-12, 9e-6, 1.1e-5, 1e-3, 0.5, 3.1])
def test_exp_times_is_the_step_on_the_left(angle_rad: float) -> None:
    rng = np.random.default_rng(int(angle_rad * 100))
    for _ in range(10):
        axis = rng.normal(size=3)
        xi = np.concatenate((rng.normal(size=3), angle_rad * axis / np.linalg.norm(axis)))
        T = se3.exp(rng.normal(size=6))
        R, t = np.empty((3, 3)), np.empty(3)
        exp_times(xi, T[:3, :3].copy(), T[:3, 3].copy(), R, t)
        expected = se3.exp(xi) @ T
        # Below 1e-5 rad the series ends after theta^2: exact to 1e-20; above, 1 - cos loses digits.
        np.testing.assert_allclose(R, expected[:3, :3], atol=1e-11)
        np.testing.assert_allclose(t, expected[:3, 3], atol=1e-9)


@pytest.mark.parametrize("n", [1, 2, 6, 8, 20])
def test_solve_symmetric_agrees_with_numpy(n: int) -> None:
    rng = np.random.default_rng(n)
    J = rng.normal(size=(3 * n, n))
    A, b, x = J.T @ J, rng.normal(size=n), np.empty(n)
    assert solve_symmetric(A.copy(), b, x)
    np.testing.assert_allclose(x, np.linalg.solve(A, b), rtol=1e-8)


def test_only_the_lower_triangle_is_read() -> None:
    A = np.array([[4.0, np.nan], [1.0, 3.0]])
    x = np.empty(2)
    assert solve_symmetric(A, np.array([1.0, 2.0]), x)
    np.testing.assert_allclose(x, [1 / 11, 7 / 11], rtol=1e-12)


@pytest.mark.parametrize(
    "A",
    [np.diag([1.0, 0.0]), np.diag([1.0, -2.0]), np.array([[1.0, 2.0], [2.0, 1.0]])],
    ids=["singular", "negative", "indefinite"],
)
def test_a_matrix_that_is_not_positive_definite_is_refused(A: np.ndarray) -> None:
    x = np.full(2, 7.0)
    assert not solve_symmetric(A.copy(), np.ones(2), x)
    assert np.array_equal(x, [0.0, 0.0])


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_bad_numbers_are_refused(bad: float) -> None:
    x = np.empty(2)
    assert not solve_symmetric(np.diag([1.0, bad]), np.ones(2), x) or np.all(np.isfinite(x))
    assert not solve_symmetric(np.eye(2), np.array([1.0, bad]), x)
