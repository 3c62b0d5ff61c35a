# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from edge.geometry import se3, so3
from edge.lines import kernels_iteration, pose
from edge.lines.line import Lines, Segments, lines_between, plane_normals, segments_between
from edge.types import F64, Mat4
from tests.edge.lines.line_scenes import (
    CAMERA,
    ends_before,
    observed,
    project,
    turned,
    viewpoint,
)

EXACT = 1e-9  # [px] or [m]


def rotation_error_rad(T: Mat4, truth: Mat4) -> float:
    return so3.angle(T[:3, :3] @ truth[:3, :3].T)


def mean_shift_px(T: Mat4, truth: Mat4, ends: F64) -> float:
    points = ends.reshape(-1, 3)
    seen, true = (project(se3.transform(pose, points)) for pose in (T, truth))
    return float(np.mean(np.linalg.norm(seen - true, axis=1)))


def scene(
    seed: int, n: int, *, flat: bool = False, noise_px: float = EXACT, noise_m: float = EXACT
) -> tuple[Lines, Segments, Mat4, F64, np.random.Generator]:
    rng = np.random.default_rng(seed)
    T = viewpoint(rng)
    ends = ends_before(rng, T, n, flat=flat)
    return *observed(rng, T, ends, noise_px, noise_m), T, ends, rng


def test_twenty_ideal_pairs_come_from_660_px_to_below_one_within_43_rounds() -> None:
    started = 0
    for seed in range(40):
        lines, segments, T, ends, rng = scene(seed, 20)
        start = turned(rng, T, np.deg2rad(60.0))
        start[:3, 3] += [3.0, 2.0, 0.0]
        if mean_shift_px(start, T, ends) < 660.0:
            continue
        started += 1
        found, rounds = pose.iterate(lines, segments, CAMERA, start, max_rounds=43)
        assert rounds <= 43
        assert mean_shift_px(found, T, ends) < 1.0
    assert started >= 5


def test_no_round_raises_the_cost() -> None:
    lines, segments, T, _, rng = scene(3, 9, noise_px=1.0, noise_m=0.01)
    start = turned(rng, T, 1.0)
    R, t = start[:3, :3].copy(), start[:3, 3].copy()
    normals, weights = plane_normals(segments, CAMERA), rng.uniform(0.2, 2.0, 9)
    pairs = (normals, lines.point, lines.direction, weights, weights)
    costs = [kernels_iteration.iterate(*pairs, 1, 0.0, R, t)[0] for _ in range(60)]
    assert np.all(np.diff(costs) <= 1e-12)
    assert costs[-1] < 0.1 * costs[0]


@pytest.mark.parametrize("flat", [False, True], ids=["in space", "in a plane"])
@pytest.mark.parametrize("n", [8, 12, 20])
def test_random_starts_within_60_degrees_find_the_minimum_at_the_truth(n: int, flat: bool) -> None:
    trials, right = 60, 0
    for seed in range(trials):
        lines, segments, T, _, rng = scene(seed, n, flat=flat, noise_px=1.0, noise_m=0.01)
        start = turned(rng, T, np.deg2rad(rng.uniform(0.0, 60.0)))
        best = pose.solve(lines, segments, CAMERA, start)[0]
        ideal = pose.refine(lines, segments, CAMERA, T)
        right += rotation_error_rad(best.T_cam_lines, ideal.T_cam_lines) < np.deg2rad(0.5)
    assert right >= 0.95 * trials  # the same minimum; the poses themselves are known to 1-3 deg


def test_exact_pairs_give_the_exact_pose_whatever_part_of_a_line_is_seen() -> None:
    lines, segments, T, ends, rng = scene(5, 8)
    start = turned(rng, T, np.deg2rad(40.0))
    along = np.sort(rng.uniform(-0.3, 1.3, (8, 2, 1)), axis=1)
    parts = ends[:, :1] + along * (ends[:, 1:] - ends[:, :1])
    _, others = observed(rng, T, parts, EXACT, EXACT)
    for seen in (segments, others):
        (best,) = pose.solve(lines, seen, CAMERA, start)
        np.testing.assert_allclose(best.T_cam_lines, T, atol=1e-6)


def test_a_start_that_is_no_rotation_any_more_gives_one() -> None:
    lines, segments, T, _, _ = scene(5, 12)
    start = T.copy()
    start[:3, :3] *= 1.001
    found = pose.refine(lines, segments, CAMERA, start).T_cam_lines
    np.testing.assert_allclose(found[:3, :3] @ found[:3, :3].T, np.eye(3), atol=1e-12)


def test_a_third_of_wrong_pairs_does_not_move_the_pose() -> None:
    lines, segments, T, _, rng = scene(8, 24, noise_px=0.5, noise_m=0.002)
    order = np.arange(24)
    order[:8] = np.roll(order[:8], 1)
    mixed = Lines(*(array[order] for array in lines))
    best = pose.solve(mixed, segments, CAMERA, turned(rng, T, np.deg2rad(10.0)))[0]
    assert rotation_error_rad(best.T_cam_lines, T) < np.deg2rad(0.5)
    assert np.all(best.m2[8:] < 25.0)
    assert np.count_nonzero(best.m2[:8] > 25.0) >= 6


def test_covariance_is_honest() -> None:
    values = []
    for seed in range(120):
        lines, segments, T, _, _ = scene(seed, 12, noise_px=1.0, noise_m=0.01)
        found = pose.refine(lines, segments, CAMERA, T, cauchy2=1e9)
        xi = se3.log(T @ se3.inverse(found.T_cam_lines))
        values.append(xi @ np.linalg.solve(found.covariance, xi))
        assert len(found.open) == 0
    assert 4.5 < np.mean(values) < 7.7  # six degrees of freedom; 120 trials hold it to 0.3


def test_both_tilts_of_a_far_plane_are_found_and_the_right_one_is_first_where_noise_allows() -> (
    None
):
    rng = np.random.default_rng(2)
    T = se3.exp([0, 0, 6.0, 0, 0, 0]) @ se3.exp([0, 0, 0, 0.6, 0.1, 0.3])
    lines, segments = observed(rng, T, ends_before(rng, T, 14, flat=True), 0.3, 1e-4)
    other = se3.exp([0, 0, 6.0, 0, 0, 0]) @ se3.exp([0, 0, 0, -0.6, 0.1, 0.3])
    for start in (T, other):
        found = pose.solve(lines, segments, CAMERA, start)
        assert len(found) == 2
        assert rotation_error_rad(found[0].T_cam_lines, T) < np.deg2rad(1.0)
        assert rotation_error_rad(found[1].T_cam_lines, T) > np.deg2rad(20.0)
        assert found[0].cost < found[1].cost


def test_parallel_lines_leave_the_way_along_them_open() -> None:
    rng = np.random.default_rng(4)
    start = rng.uniform([-1, -1, 2.5], [1, 1, 5.0], (10, 3))
    half = np.array([0, 0.4, 0])
    first, last = start - half, start + half
    pixels = np.hstack((project(first), project(last)))
    lines = lines_between(first, last, 1e-3)
    found = pose.refine(lines, segments_between(pixels, 0.5), CAMERA, np.eye(4))
    (free,) = found.open
    np.testing.assert_allclose(np.abs(free), [0, 1, 0, 0, 0, 0], atol=1e-4)
    sigma = np.sqrt(np.diag(found.covariance))
    assert sigma[1] > 1e3
    assert np.all(sigma[[0, 2]] < 0.1)
    assert np.all(sigma[3:] < 0.1)


def test_lines_in_one_plane_with_the_centre_leave_three_ways_open() -> None:
    rng = np.random.default_rng(6)
    first = rng.uniform([-1, 0.0, 2.5], [0, 0, 4.0], (10, 3))
    last = first + rng.uniform([0.5, 0, -0.5], [1, 0, 0.5], (10, 3))
    pixels = np.hstack((project(first), project(last)))
    lines = lines_between(first, last, 1e-3)
    found = pose.refine(lines, segments_between(pixels, 0.5), CAMERA, np.eye(4))
    assert len(found.open) == 3
    held = np.delete(np.eye(6), [0, 2, 4], axis=0)  # across the plane, and the turns about it
    np.testing.assert_allclose(held @ found.open.T, 0.0, atol=1e-3)


def test_a_twin_behind_the_camera_is_never_given() -> None:
    for seed in range(10):
        lines, segments, T, _, rng = scene(seed, 12, flat=True, noise_px=0.5, noise_m=1e-3)
        start = turned(rng, T, np.deg2rad(50.0))
        start[:3, 3] = -start[:3, 3]
        for found in pose.solve(lines, segments, CAMERA, start):
            assert np.median(lines.point @ found.T_cam_lines[2, :3] + found.T_cam_lines[2, 3]) > 0
