# SPDX-License-Identifier: Apache-2.0
import numpy as np

from edge.geometry import se3
from edge.odometry import kernels_reference as kr
from edge.odometry.kernels_window import POINT_ROWS
from edge.odometry.system import relative_warps
from tests.edge.odometry import numeric
from tests.edge.odometry.scenes import SMALL

INTRINSICS = np.array([SMALL.fx, SMALL.fy, SMALL.cx, SMALL.cy], np.float32)
SIZE = (SMALL.height, SMALL.width)


def test_points_are_projected_from_their_hosts() -> None:
    rng = np.random.default_rng(0)
    poses = [se3.exp(rng.normal(0.0, 0.1, 6)) for _ in range(3)]
    points = np.zeros((POINT_ROWS, 90), np.float32)
    points[0], points[1] = rng.uniform(0, 159, 90), rng.uniform(0, 119, 90)
    points[2] = rng.uniform(0.2, 1.0, 90)
    host, out = np.repeat([0, 1, 2], 30).astype(np.int32), np.empty((3, 90), np.float32)
    warps = relative_warps(poses).astype(np.float32)
    kr.project_points(points, host, warps, INTRINSICS, 2, out)

    assert np.array_equal(out[:, 60:], points[:3, 60:])  # the target's own stay as they are
    for h in (0, 1):
        u, v, idepth = points[:3, host == h].astype(np.float64)
        x, y = (u - SMALL.cx) / SMALL.fx, (v - SMALL.cy) / SMALL.fy
        T = poses[2] @ se3.inverse(poses[h])
        pixels = numeric.project(T, x, y, idepth, INTRINSICS)
        xyz = np.column_stack((x, y, np.ones_like(x))) / idepth[:, None]
        np.testing.assert_allclose(out[:2, host == h].T, pixels, atol=1e-3)
        np.testing.assert_allclose(out[2, host == h], 1 / se3.transform(T, xyz)[:, 2], rtol=1e-4)


def test_points_behind_the_target_are_marked() -> None:
    poses = [np.eye(4), se3.exp([0, 0, -5.0, 0, 0, 0])]
    points, out = np.full((POINT_ROWS, 1), 50.0, np.float32), np.empty((3, 1), np.float32)
    points[2] = 1.0
    warps = relative_warps(poses).astype(np.float32)
    kr.project_points(points, np.zeros(1, np.int32), warps, INTRINSICS, 1, out)
    assert not np.any(out)


def test_splatted_depths_are_weighted_means_at_every_level() -> None:
    depth, total = np.zeros(SIZE, np.float32), np.zeros(SIZE, np.float32)
    projected = np.array(
        [
            [20.2, 19.8, 21.4, 40.0, 60.0, 1.0],
            [30.4, 29.6, 31.0, 50.0, 70.0, 50.0],
            [1, 2, 4, 8, 0, 9],
        ],
        np.float32,
    )
    weight = np.array([1.0, 3.0, 1.0, 0.0, 5.0, 1.0], np.float32)
    kr.splat(projected, weight, depth, total)
    assert np.argwhere(total).tolist() == [[30, 20], [31, 21]]  # no weight, no depth, border: none
    assert depth[30, 20] / total[30, 20] == np.float32(7.0 / 4.0)
    half = (60, 80)
    depth2, total2 = np.zeros(half, np.float32), np.zeros(half, np.float32)
    kr.halve_sums(depth, total, depth2, total2)
    assert np.argwhere(total2).tolist() == [[15, 10]]
    assert (depth2[15, 10], total2[15, 10]) == (11.0, 5.0)


def collected(dilate: int, capacity: int = 100) -> np.ndarray:
    depth, total = np.zeros(SIZE, np.float32), np.zeros(SIZE, np.float32)
    depth[30, 20], total[30, 20] = 3.0, 2.0
    depth[31, 21], total[31, 21] = 8.0, 2.0
    mask = np.ones(SIZE, np.uint8)
    mask[30, 19] = 0
    level, out = numeric.static(*SIZE, 3), np.empty((5, capacity), np.float32)
    n = kr.collect(level, mask, depth, total, INTRINSICS, np.float32(7.0), dilate, out)
    pixels = np.rint(out[:2, :n].T * [SMALL.fx, SMALL.fy] + [SMALL.cx, SMALL.cy]).astype(int)
    for (u, v), row in zip(pixels, out[:, :n].T, strict=True):
        assert row[3] == level[v, u, 0] - np.float32(7.0)
        assert row[4] == 1.0
    return np.column_stack((pixels, out[2, :n]))


def test_pixels_with_a_depth_become_tracking_points() -> None:
    assert collected(0).tolist() == [[20, 30, 1.5], [21, 31, 4.0]]
    assert len(collected(0, capacity=1)) == 1


def test_neighbours_share_the_depth_where_they_have_none() -> None:
    straight = collected(1)
    rows = {(int(u), int(v)): d for u, v, d in straight}
    assert rows[20, 30] == 1.5  # its own depth is kept
    assert rows[21, 30] == np.float32(11.0 / 4.0)  # between both
    assert rows[20, 29] == 1.5
    assert (19, 30) not in rows  # masked
    assert len(rows) == 2 + 8 - 2 - 1  # two crosses share two pixels; one is masked

    diagonal = {(int(u), int(v)): d for u, v, d in collected(2)}
    for u, v in ((19, 29), (21, 29), (19, 31)):
        assert diagonal[u, v] == 1.5
    for u, v in ((22, 32), (20, 32), (22, 30)):
        assert diagonal[u, v] == 4.0
    assert len(diagonal) == 2 + 8 - 2  # each is a diagonal neighbour of the other
