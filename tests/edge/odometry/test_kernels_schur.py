# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from edge.odometry import kernels_schur as ks


@pytest.mark.parametrize("damping", [0.0, 0.1])
def test_eliminating_depths_equals_the_dense_solution(damping: float) -> None:
    rng = np.random.default_rng(3)
    n, f = 70, 3
    J = rng.normal(size=(400, 8 * f + n))
    whole = J.T @ J
    # Depths do not touch one another.
    Hd = np.diag(whole)[8 * f :].copy()
    whole[8 * f :, 8 * f :] = np.diag(Hd * (1.0 + damping))
    whole[: 8 * f, 8 * f :] *= 0.2
    whole[8 * f :, : 8 * f] *= 0.2
    b = rng.normal(size=8 * f + n)
    solution = -np.linalg.solve(whole, b)

    W = whole[: 8 * f, 8 * f :].astype(np.float32)
    H_reduced, b_reduced = whole[: 8 * f, : 8 * f].copy(), b[: 8 * f].copy()
    Hd32, bd32 = Hd.astype(np.float32), b[8 * f :].astype(np.float32)
    ks.eliminate_depths(W, Hd32, bd32, np.float32(damping), np.empty_like(W), H_reduced, b_reduced)
    dx = -np.linalg.solve(H_reduced, b_reduced)
    np.testing.assert_allclose(dx, solution[: 8 * f], atol=1e-5 * np.abs(solution).max())
    np.testing.assert_allclose(H_reduced, H_reduced.T, rtol=1e-6, atol=1e-6)

    steps = np.empty(n, np.float32)
    ks.depth_steps(W, Hd32, bd32, dx.astype(np.float32), np.float32(damping), steps)
    np.testing.assert_allclose(steps, solution[8 * f :], atol=1e-5 * np.abs(solution).max())


def test_a_depth_that_nothing_holds_does_not_move() -> None:
    W, H, b = np.zeros((8, 3), np.float32), np.eye(8), np.ones(8)
    Hd, bd = np.array([1.0, 0.0, 2.0], np.float32), np.array([1.0, 0.0, 4.0], np.float32)
    ks.eliminate_depths(W, Hd, bd, np.float32(0.0), np.empty_like(W), H, b)
    assert np.array_equal(H, np.eye(8))
    steps = np.empty(3, np.float32)
    ks.depth_steps(W, Hd, bd, np.ones(8, np.float32), np.float32(0.0), steps)
    assert np.array_equal(steps, np.array([-1.0, 0.0, -2.0], np.float32))
