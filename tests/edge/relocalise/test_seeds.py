# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from edge.geometry import se3
from edge.lines.line import Lines, Segments, lines_between, moved, segments_between
from edge.relocalise.assessment import Solution
from edge.relocalise.match import Matches
from edge.relocalise.seeds import along_lines, depths, joined
from edge.types import F64, Mat4
from tests.edge.relocalise.pools import pool_of
from tests.edge.relocalise.room_matches import CAMERA


def test_depths_of_the_inliers_are_those_from_the_pose() -> None:
    rng = np.random.default_rng(0)
    n = 50
    T = se3.exp(rng.normal(size=6))
    pixels = rng.uniform((20, 20), (620, 460), (n, 2))
    depth = rng.uniform(1.0, 4.0, n)
    rays = (pixels - (CAMERA.cx, CAMERA.cy)) / CAMERA.fx
    xyz = se3.transform(T, np.column_stack((rays * depth[:, None], depth)))
    pool = pool_of(xyz, np.tile(4e-4 * np.eye(3), (n, 1, 1)), T)
    row = rng.permutation(n).astype(np.int32)
    found = Matches(np.arange(n, dtype=np.int32), row, np.zeros(n, np.int32))
    inlier = rng.random(n) < 0.7
    solution = Solution(T, np.eye(6), inlier, 1.0, 1.0, 9, 0.2, 2.0)

    told = depths(pool, found, solution, CAMERA)

    assert told.pixels == pytest.approx(pixels[row[inlier]], abs=1e-2)
    assert 1.0 / told.inverse_depth == pytest.approx(depth[row[inlier]], rel=1e-4)
    assert told.sigma / told.inverse_depth**2 == pytest.approx(0.02, rel=1e-3)
    assert not told.inverse_depth.flags.writeable


def seen_lines(T_map_cam: Mat4) -> tuple[Lines, Segments, F64]:
    """Lines in the map, their images, and the ends [m, camera] between which they are seen."""
    rng = np.random.default_rng(1)
    pixels = rng.uniform((20, 20), (620, 460), (12, 2, 2))
    rays = np.insert((pixels - (CAMERA.cx, CAMERA.cy)) / CAMERA.fx, 2, 1.0, axis=2)
    ends = rays * rng.uniform(1.0, 4.0, (12, 2, 1))
    first, last = (se3.transform(T_map_cam, ends[:, k]) for k in (0, 1))
    return lines_between(first, last, 0.01), segments_between(pixels.reshape(-1, 4), 0.2), ends


def test_depths_along_lines_are_those_where_the_rays_meet_them() -> None:
    T = se3.exp(np.random.default_rng(2).normal(size=6))
    lines, segments, ends = seen_lines(T)
    span = 0.5 * np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)[:, None] * [-1.0, 1.0]

    told = along_lines(lines, span, segments, T, CAMERA)

    assert len(told.pixels) > 12 * 5
    rays = np.insert((told.pixels - (CAMERA.cx, CAMERA.cy)) / CAMERA.fx, 2, 1.0, axis=1)
    xyz = rays / told.inverse_depth[:, None]
    off = np.cross(xyz[:, None] - ends[:, 0], ends[:, 1] - ends[:, 0])
    distance = np.linalg.norm(off, axis=2) / np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    assert distance.min(axis=1) == pytest.approx(0.0, abs=1e-4)
    half = along_lines(lines, 0.5 * span, segments, T, CAMERA)
    assert len(half.pixels) < 0.8 * len(told.pixels)


@pytest.mark.parametrize("freedom", range(4))
def test_sigmas_along_lines_are_what_a_step_of_one_sigma_does(freedom: int) -> None:
    T = se3.exp(np.random.default_rng(2).normal(size=6))
    lines, segments, _ = seen_lines(T)
    everywhere = np.full((12, 1), 1e3) * [-1.0, 1.0]
    step = np.zeros((12, 4))
    step[:, freedom] = 1e-3
    covariance = step[:, :, None] * step[:, None, :]

    told = along_lines(lines._replace(covariance=covariance), everywhere, segments, T, CAMERA)
    after = along_lines(moved(lines, step), everywhere, segments, T, CAMERA)

    change = np.abs(1.0 / after.inverse_depth - 1.0 / told.inverse_depth)
    assert told.sigma / told.inverse_depth**2 == pytest.approx(change, rel=0.1, abs=1e-4)


def test_joined_depths_are_both() -> None:
    lines, segments, _ = seen_lines(np.eye(4))
    told = along_lines(lines, np.tile([-9.0, 9.0], (12, 1)), segments, np.eye(4), CAMERA)

    both = joined(told, told)

    assert joined(None, told) is told
    assert both.pixels == pytest.approx(np.vstack((told.pixels, told.pixels)))
    assert len(both.inverse_depth) == len(both.sigma) == 2 * len(told.sigma)
