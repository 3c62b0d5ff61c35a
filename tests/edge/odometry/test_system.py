# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from edge.geometry import se3
from edge.odometry.gauge import null_directions
from edge.odometry.keyframe import Keyframe
from edge.odometry.prior import MarginalPrior
from edge.odometry.system import relative_adjoints, relative_affines, relative_warps
from edge.types import F64, Frame

NOTHING = Frame(0, 0, np.zeros((2, 2), np.uint8))


def make_keyframes(n: int, *, moved: bool = True) -> list[Keyframe]:
    rng = np.random.default_rng(n)
    keyframes = [
        Keyframe(NOTHING, i, se3.exp(rng.normal(0, 0.3, 6)), rng.normal(size=2)) for i in range(n)
    ]
    if moved:
        for keyframe in keyframes:
            keyframe.delta = rng.normal(0, 0.01, 8)
    return keyframes


def random_quadratic(n: int, seed: int) -> tuple[F64, F64]:
    rng = np.random.default_rng(seed)
    J = rng.normal(size=(4 * n, n)) * rng.uniform(0.1, 30.0, n)  # unknowns of unequal size
    return J.T @ J, rng.normal(size=n) * np.sqrt(np.diag(J.T @ J))


def test_warps_take_points_from_host_to_target() -> None:
    poses = [k.T_cam_odom for k in make_keyframes(4)]
    warps = relative_warps(poses)
    for host in range(4):
        for target in range(4):
            expected = poses[target] @ se3.inverse(poses[host])
            R, t = warps[host, target, :9].reshape(3, 3), warps[host, target, 9:]
            np.testing.assert_allclose(R, expected[:3, :3], atol=1e-12)
            np.testing.assert_allclose(t, expected[:3, 3], atol=1e-12)


def test_a_step_of_the_host_moves_the_relative_pose_by_the_adjoint() -> None:
    poses = [k.T_cam_odom for k in make_keyframes(3)]
    adjoints = relative_adjoints(relative_warps(poses)).reshape(3, 3, 6, 6)
    rng = np.random.default_rng(0)
    for host in range(3):
        for target in range(3):
            step = 1e-6 * rng.normal(size=6)
            before = poses[target] @ se3.inverse(poses[host])
            after = poses[target] @ se3.inverse(se3.exp(step) @ poses[host])
            moved = se3.log(after @ se3.inverse(before))
            np.testing.assert_allclose(moved, adjoints[host, target] @ step, atol=1e-10)


def test_affines_are_gain_offset_and_first_gain() -> None:
    now, first = np.array([[0.1, 2.0], [0.4, -3.0]]), np.array([[0.0, 1.0], [0.2, 0.0]])
    affine = relative_affines(now, first)
    np.testing.assert_allclose(affine[0, 1], [np.exp(0.3), -3.0, np.exp(0.2)], rtol=1e-6)
    np.testing.assert_allclose(affine[1, 0], [np.exp(-0.3), 2.0, np.exp(-0.2)], rtol=1e-6)


def test_null_directions_are_moves_of_the_whole_frame_and_its_scale() -> None:
    keyframes = make_keyframes(3, moved=False)
    N = null_directions(keyframes)
    assert np.linalg.matrix_rank(N) == 7
    size = 1e-6
    for column in range(6):
        step = np.zeros(6)
        step[column] = size
        moved = [se3.log(k.T_first @ se3.exp(step) @ se3.inverse(k.T_first)) for k in keyframes]
        check_direction(N[:, column], moved)
    scaled = []
    for keyframe in keyframes:
        T = keyframe.T_first.copy()
        T[:3, 3] *= 1.0 + size
        scaled.append(se3.log(T @ se3.inverse(keyframe.T_first)))
    check_direction(N[:, 6], scaled)


def check_direction(column: F64, twists: list[F64]) -> None:
    direction = np.concatenate([np.r_[twist, 0.0, 0.0] for twist in twists])
    np.testing.assert_allclose(column, direction / np.linalg.norm(direction), atol=1e-5)


def test_a_term_is_added_at_the_current_state() -> None:
    keyframes = make_keyframes(3)
    delta = np.concatenate([k.delta for k in keyframes])
    H, gradient = random_quadratic(24, 1)
    prior = grown(3)
    assert prior.is_empty
    prior.add(H, gradient, keyframes)
    assert not prior.is_empty
    np.testing.assert_allclose(prior.gradient(keyframes), gradient, rtol=1e-8)

    # The energy's slope at another state is twice the gradient there.
    rng = np.random.default_rng(2)
    for keyframe in keyframes:
        keyframe.delta = rng.normal(size=8)
    whole = prior.gradient(keyframes)
    np.testing.assert_allclose(
        whole, gradient + H @ (np.concatenate([k.delta for k in keyframes]) - delta), rtol=1e-8
    )
    for axis in range(24):
        keyframe, k = keyframes[axis // 8], axis % 8
        energies = []
        for step in (1e-3, -1e-3):
            keyframe.delta[k] += step
            energies.append(prior.energy(keyframes))
            keyframe.delta[k] -= step
        assert (energies[0] - energies[1]) / 2e-3 == pytest.approx(2.0 * whole[axis], rel=1e-5)


@pytest.mark.parametrize("gone", [0, 1, 3])
def test_eliminating_a_frame_keeps_the_optimum_of_the_others(gone: int) -> None:
    keyframes = make_keyframes(4)
    H, gradient = random_quadratic(32, 3)
    prior = grown(4)
    prior.add(H, gradient, keyframes)
    best = -np.linalg.solve(prior.H, prior.b).reshape(4, 8)
    prior.eliminate(gone)

    np.testing.assert_allclose(
        -np.linalg.solve(prior.H, prior.b).reshape(3, 8), np.delete(best, gone, axis=0), rtol=1e-5
    )
    # Its energy is what the whole energy falls to when the lost frame is left free.
    left = np.delete(np.arange(32), np.arange(8 * gone, 8 * gone + 8))
    lost = np.arange(8 * gone, 8 * gone + 8)
    expected = H[np.ix_(left, left)] - H[np.ix_(left, lost)] @ np.linalg.solve(
        H[np.ix_(lost, lost)], H[np.ix_(lost, left)]
    )
    np.testing.assert_allclose(prior.H, expected, rtol=1e-5, atol=1e-6 * np.abs(expected).max())


def test_eliminating_a_frame_that_nothing_holds_changes_nothing() -> None:
    keyframes = make_keyframes(2)
    H, b = np.zeros((16, 16)), np.zeros(16)
    H[:8, :8], b[:8] = random_quadratic(8, 4)
    prior = grown(2)
    prior.add(H, b, keyframes)
    before = prior.gradient(keyframes)[:8]
    prior.eliminate(1)
    np.testing.assert_allclose(prior.H, H[:8, :8], rtol=1e-12)
    np.testing.assert_allclose(prior.gradient(keyframes[:1]), before, rtol=1e-9)


def test_the_order_of_elimination_does_not_matter() -> None:
    keyframes = make_keyframes(4)
    H, gradient = random_quadratic(32, 5)
    priors = [grown(4), grown(4)]
    for prior, order in zip(priors, ((0, 1), (2, 0)), strict=True):  # of 0 and 2, shifted
        prior.add(H, gradient, keyframes)
        for index in order:
            prior.eliminate(index)
    np.testing.assert_allclose(priors[0].H, priors[1].H, rtol=1e-6)
    np.testing.assert_allclose(priors[0].b, priors[1].b, rtol=1e-6)


def grown(n: int) -> MarginalPrior:
    prior = MarginalPrior()
    for _ in range(n):
        prior.grow()
    return prior
