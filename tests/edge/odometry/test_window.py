# SPDX-License-Identifier: Apache-2.0
from collections.abc import Sequence

import numpy as np
import pytest

from edge.geometry import se3
from edge.odometry import kernels_window as kw
from edge.odometry.gauge import null_directions
from edge.odometry.keyframe import rescale
from edge.odometry.system import FrameState, Packing
from edge.odometry.window import Window
from edge.types import F64
from tests.edge.odometry.built_window import (
    POSES,
    build_window,
    disturb,
    photometric_energy,
    reduced_system,
)
from tests.edge.odometry.scenes import Corner, centres, rmse_after_similarity

BRIGHTNESS = [(0.0, 0.0), (0.2, 6.0), (-0.15, -4.0), (0.1, -8.0), (0.25, 3.0)]


def smooth_corner(seed: int) -> Corner:
    """Waves so long that a pattern finds its way home over several pixels."""
    return Corner(seed, wavelengths_m=(0.35, 1.5), contrast_grey=35.0)


def error_m(window: Window) -> float:
    found = centres([k.T_odom_cam for k in window.keyframes])
    return rmse_after_similarity(found, centres(POSES))


def depth_errors(window: Window, truth: F64) -> F64:
    """Relative errors of the inverse depths, after their common scale."""
    ratio = window.points[kw.IDEPTH] / truth
    return np.asarray(ratio / np.median(ratio) - 1.0)


@pytest.mark.parametrize("seed", range(5))
def test_the_window_converges_to_the_truth(seed: int) -> None:
    window = build_window(smooth_corner(seed))
    truth = window.points[kw.IDEPTH].copy()
    window.points[kw.GOOD_VIEWS] = np.arange(len(truth))  # who is who, when some are dropped
    disturb(window, seed, shift=0.015, turn=0.004, depth=0.08)
    before = error_m(window)
    window.optimise(20)
    window.optimise(20)  # without those that were no match at first
    left = np.rint(window.points[kw.GOOD_VIEWS]).astype(int)
    left -= 2 * (window.residual[-1] == kw.INLIER)  # it counts the newest frame's views
    assert before > 6e-3
    assert error_m(window) < 4e-3  # at 2.5 m depth: a third of a pixel
    assert len(left) > 0.9 * len(truth)
    # A pattern sees its surface as if it faced the camera, which biases slanted ones a little.
    known = np.isin(left, np.arange(len(truth)))
    errors = depth_errors(window, truth[np.clip(left, 0, len(truth) - 1)])[known]
    assert np.median(np.abs(errors)) < 0.02


def test_the_truth_is_nearly_where_the_window_rests() -> None:
    window = build_window(smooth_corner(1))
    window.optimise(10)
    assert error_m(window) < 2e-3


def test_brightness_is_recovered_up_to_what_no_image_shows() -> None:
    window = build_window(smooth_corner(2), brightness=BRIGHTNESS)
    for keyframe in window.keyframes:
        keyframe.affine_first = (
            keyframe.affine_first + np.array([0.03, -2.0]) * (-1.0) ** keyframe.slot
        )
    disturb(window, 2, shift=0.005, turn=0.001, depth=0.05)
    window.optimise(20)
    window.optimise(20)
    a, b = np.stack([k.affine for k in window.keyframes]).T
    true_a, true_b = np.array(BRIGHTNESS).T
    np.testing.assert_allclose(np.exp(a[1:] - a[0]), np.exp(true_a[1:] - true_a[0]), rtol=0.03)
    # What a scene grey of 110 in frame 0 becomes in the others.
    seen = np.exp(a - a[0]) * (110.0 - b[0]) + b
    np.testing.assert_allclose(seen, np.exp(true_a) * 110.0 + true_b, atol=1.5)
    assert error_m(window) < 2e-3


def test_exactly_the_gauge_is_unseen() -> None:
    window = build_window(Corner(3))
    H, _ = reduced_system(window)
    # Two directions of brightness are seen by none but its weak prior; hold brightness.
    brightness = np.arange(len(H)) % 8 >= 6
    H[brightness, brightness] *= 10.0
    size = 1.0 / np.sqrt(np.diag(H))
    eigenvalues = np.linalg.eigvalsh(H * np.outer(size, size))
    # float32 sums leave some 1e-8 of the largest.
    assert np.all(np.abs(eigenvalues[:7]) < 1e-6 * eigenvalues[-1])
    assert eigenvalues[7] > 1e-4 * eigenvalues[-1]


def test_gauge_directions_are_in_the_null_space() -> None:
    window = build_window(Corner(4))
    H, b = reduced_system(window)
    N = null_directions(window.keyframes)
    size = np.sqrt(np.diag(H))
    for direction in N.T:
        length = np.linalg.norm(size * direction)
        assert np.linalg.norm((H @ direction) / size) < 1e-4 * length
        assert abs(b @ direction) < 1e-4 * np.linalg.norm(b / size) * length
    # Other directions are seen: a random one keeps a good part of its length.
    other = np.random.default_rng(0).normal(size=len(b)) / size
    assert np.linalg.norm((H @ other) / size) > 1e-2 * np.linalg.norm(size * other)


@pytest.mark.parametrize("scale", [1.0, 1.4])
def test_moving_turning_and_scaling_the_whole_changes_no_residual(scale: float) -> None:
    window = build_window(Corner(5))
    disturb(window, 5, shift=0.005, turn=0.002, depth=0.02)
    before = photometric_energy(window)
    G = se3.exp([0.3, -0.2, 0.5, 0.4, -0.1, 0.2])
    for keyframe in window.keyframes:
        T = keyframe.T_first.copy()
        T[:3, 3] *= scale
        keyframe.T_first = T @ G
    window.points[kw.IDEPTH] /= scale
    assert photometric_energy(window) == pytest.approx(before, rel=1e-4)


def test_marginalising_keeps_the_step_of_all_that_remains() -> None:
    # One linearisation is a linear problem: what is taken out may not change its solution.
    window = build_window(Corner(6), marginal_weight=1.0)
    disturb(window, 6, shift=0.004, turn=0.001, depth=0.02)
    rng = np.random.default_rng(7)
    for keyframe in window.keyframes:  # first estimates lie elsewhere than the state
        keyframe.delta = rng.normal(0.0, np.repeat((1e-3, 0.01, 0.5), (6, 1, 1)))
    forget_residuals_in_first_frame(window)
    # Brightness common to all frames is held by its weak prior alone: float32 leaves it loose.
    units = np.array([*(6 * [1.0]), 5.0, 100.0])
    whole = step_of(*reduced_system(window))

    window.marginalise_points(window.host == 0)
    np.testing.assert_allclose(step_of(*reduced_system(window)) / units, whole / units, atol=1e-4)
    assert not np.any(window.host == 0)

    window.marginalise_keyframe(0)
    assert len(window.keyframes) == 4
    assert window.host.min() == 0
    # Without frame 0 another member of the same family of solutions is the shortest.
    apart = (step_of(*reduced_system(window)) - whole[1:]).ravel()
    N = null_directions(window.keyframes)
    apart -= N @ np.linalg.lstsq(N, apart, rcond=None)[0]
    np.testing.assert_allclose(apart.reshape(4, 8) / units, 0.0, atol=1e-4)


def forget_residuals_in_first_frame(window: Window) -> None:
    """As the mapper does when a frame leaves: what others see in it is dropped."""
    window.residual[0, window.host != 0] = kw.UNUSED


def step_of(H: F64, b: F64) -> F64:
    """Gauss-Newton step (f, 8) without its part along the gauge."""
    size = 1.0 / np.sqrt(np.diag(H))
    eigenvalues, vectors = np.linalg.eigh(H * np.outer(size, size))
    seen = vectors[:, 7:]
    step = -(seen / eigenvalues[7:]) @ (seen.T @ (size * b))
    return np.asarray((size * step).reshape(-1, 8))


def test_a_window_that_lost_its_first_frame_still_finds_the_truth() -> None:
    window = build_window(smooth_corner(1), marginal_weight=1.0)
    window.optimise(10)
    forget_residuals_in_first_frame(window)
    window.marginalise_points(window.host == 0)
    window.marginalise_keyframe(0)
    for keyframe in window.keyframes:
        keyframe.delta = keyframe.delta + np.r_[np.full(6, 1e-3), 0.0, 0.0]
    window.optimise(10)
    found = centres([k.T_odom_cam for k in window.keyframes])
    assert rmse_after_similarity(found, centres(POSES[1:])) < 3e-3
    # The prior holds position and scale too: nothing drifts away along the gauge.
    assert np.abs(found - centres(POSES[1:])).max() < 0.02


def test_the_first_keyframe_holds_the_odometry_frame_while_nothing_else_does() -> None:
    window = build_window(smooth_corner(3))
    disturb(window, 3, shift=0.01, turn=0.002, depth=0.05)
    before = window.keyframes[0].T_cam_odom
    window.optimise(10)
    np.testing.assert_allclose(window.keyframes[0].T_cam_odom, before, atol=1e-7)


def test_steps_do_not_go_along_the_gauge_once_a_prior_is_there() -> None:
    window = build_window(smooth_corner(4))
    window.optimise(10)
    window.marginalise_points(window.host == 0)
    rng = np.random.default_rng(4)
    for keyframe in window.keyframes:
        keyframe.delta = keyframe.delta + rng.normal(0.0, np.repeat((3e-3, 0.0), (6, 2)))
    before = [k.T_cam_odom for k in window.keyframes]
    N = null_directions(window.keyframes)
    window.optimise(6)
    moved = np.concatenate(
        [
            np.r_[se3.log(k.T_cam_odom @ se3.inverse(T)), 0.0, 0.0]
            for k, T in zip(window.keyframes, before, strict=True)
        ]
    )
    Q, _ = np.linalg.qr(N)
    assert np.linalg.norm(moved) > 3e-3
    # Brightness has no part in the gauge; twists add up to second order only.
    assert np.linalg.norm(Q.T @ moved) < 0.01 * np.linalg.norm(moved)


def test_information_is_kept_with_its_weight() -> None:
    priors = []
    for weight in (1.0, 0.25):
        window = build_window(Corner(6), marginal_weight=weight)
        disturb(window, 6, shift=0.004, turn=0.001, depth=0.02)
        window.marginalise_points(window.host == 0)
        priors.append(window.prior)
    np.testing.assert_allclose(priors[1].H, 0.25 * priors[0].H, rtol=1e-6)
    np.testing.assert_allclose(priors[1].b, 0.25 * priors[0].b, rtol=1e-6)


def test_outliers_leave_and_points_without_residuals_too() -> None:
    window = build_window(Corner(8))
    n = window.points.shape[1]
    window.points[kw.IDEPTH, :40] *= 2.0
    window.points[kw.IDEPTH, 40:44] = np.float32(np.nan)
    window.optimise(6)
    assert n - 60 < window.points.shape[1] < n - 20
    assert np.all(window.points[kw.IDEPTH] > 0)
    assert set(np.unique(window.residual)) <= {kw.UNUSED, kw.INLIER}
    assert np.all((window.residual == kw.INLIER).any(axis=0))
    shapes = (window.points.shape[1], window.host.size, window.residual.shape[1])
    assert len({*shapes, window.misses.size, window.depth_information.size}) == 1


def test_optimising_twice_is_the_same_byte_for_byte() -> None:
    def run() -> tuple[bytes, bytes]:
        window = build_window(Corner(9))
        disturb(window, 9, shift=0.01, turn=0.002, depth=0.05)
        window.optimise(6)
        poses = np.stack([k.T_cam_odom for k in window.keyframes])
        return poses.tobytes(), window.points.tobytes()

    assert run() == run()


def test_a_frame_that_nothing_holds_ends_nothing() -> None:
    window = build_window(smooth_corner(2))
    window.residual[-1] = kw.UNUSED
    before = window.keyframes[-1].T_odom_cam.copy()
    window.optimise(6)
    assert np.allclose(window.keyframes[-1].T_odom_cam, before)
    assert error_m(window) < 4e-3


@pytest.mark.parametrize("unit", [0.05, 1.0, 30.0])
def test_a_window_is_left_once_it_has_settled_in_whatever_units(unit: float) -> None:
    window = build_window(smooth_corner(1))
    disturb(window, 1, shift=0.005, turn=0.001, depth=0.03)
    rescale(window.keyframes, unit)
    window.points[kw.IDEPTH] /= np.float32(unit)
    linearise, looks = window._system.linearise, 0

    def counted(packing: Packing, keyframes: Sequence[FrameState]) -> float:
        nonlocal looks
        looks += 1
        return linearise(packing, keyframes)

    window._system.linearise = counted  # type: ignore[method-assign]
    window.optimise(30)
    assert looks <= 8  # 5; without an end 11 and more
    assert error_m(window) < 2e-3


def test_what_one_frame_sees_does_not_hang_on_the_others() -> None:
    window = build_window(smooth_corner(3))
    packing = window._pack(np.ones(len(window.host), np.bool_))
    target = len(window.keyframes) - 2
    alone = packing.seen_by(target)
    window._system.linearise(alone, window.keyframes)
    assert np.all(np.delete(alone.state, target, axis=0) == kw.UNUSED)
    told = alone.energy_of(target).copy()
    window._system.linearise(packing, window.keyframes)
    assert len(told) > 100
    np.testing.assert_array_equal(told, packing.energy_of(target))


@pytest.mark.parametrize("contrast_grey", [60.0, 8.0])
def test_plain_images_tell_nothing_of_the_lens(contrast_grey: float) -> None:
    """Poses that slip along edges look like a bend of the lens."""
    poses = [se3.exp([0.04 * i - 0.12, 0.02 * i, 0.0, 0.0, -0.01 * i, 0.0]) for i in range(7)]
    window = build_window(Corner(3, contrast_grey=contrast_grey), poses)
    window.optimise(3)
    assert window.lines.is_plain is (contrast_grey < 10.0)
    assert (window.lens is None) is window.lines.is_plain
