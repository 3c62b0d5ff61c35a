# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from edge.geometry import se3
from edge.odometry import kernels_flow as kf
from edge.odometry import kernels_track as kt
from edge.types import F32, F64, Mat4
from tests.edge.odometry import numeric
from tests.edge.odometry.scenes import SMALL

INTRINSICS = np.array([SMALL.fx, SMALL.fy, SMALL.cx, SMALL.cy], np.float32)
MASK = np.ones((SMALL.height, SMALL.width), np.uint8)
PARAMETERS = ["tx", "ty", "tz", "rx", "ry", "rz", "a", "b"]
HUBER = 9.0
NO_CUTOFF = np.float32(1e6)


def make_points(seed: int, n: int = 300, quadrant: bool = False) -> F32:
    rng = np.random.default_rng(seed)
    points = np.empty((5, n), np.float32)
    points[0] = rng.uniform(0.05, 0.3, n) if quadrant else rng.uniform(-0.6, 0.6, n)
    points[1] = rng.uniform(0.05, 0.2, n) if quadrant else rng.uniform(-0.4, 0.4, n)
    points[2] = rng.uniform(0.2, 1.5, n)
    points[3] = rng.uniform(60.0, 140.0, n)
    points[4] = rng.uniform(0.2, 1.0, n)
    return points


def accumulate(
    level: F32,
    points: F32,
    T: Mat4,
    affine: F64,
    *,
    huber: float = HUBER,
    cutoff: np.float32 = NO_CUTOFF,
    mask: np.ndarray = MASK,
) -> F64:
    sums = np.empty(kt.N_SUMS)
    R, t = np.ascontiguousarray(T[:3, :3]), np.ascontiguousarray(T[:3, 3])
    n = points.shape[1]
    kt.accumulate(level, mask, points, n, INTRINSICS, R, t, affine, np.float32(huber), cutoff, sums)
    return sums


def unpacked(sums: F64) -> tuple[F64, F64]:
    H, b = np.empty((8, 8)), np.empty(8)
    kt.unpack(sums, H, b)
    return H, b


def pose(seed: int) -> Mat4:
    return se3.exp(np.random.default_rng(seed).normal(0.0, 0.04, 6))


@pytest.mark.parametrize("axis", range(8), ids=PARAMETERS)
def test_b_is_half_of_the_slope_of_the_energy(axis: int) -> None:
    # On a ramp interpolation is exact; points of one quadrant let no row cancel itself out.
    level = numeric.ramp(SMALL.height, SMALL.width, 0.5, -0.35 if axis == 5 else 0.35)
    points = make_points(axis, quadrant=True)
    T, affine = pose(axis), np.array([0.1, 6.0])

    def energy(size: float) -> float:
        step = size * np.eye(8)[axis]
        return float(accumulate(level, points, se3.exp(step[:6]) @ T, affine + step[6:])[44])

    size = 0.3 if axis == 7 else 3e-3  # of some grey: float32 sums keep five digits
    _, b = unpacked(accumulate(level, points, T, affine))

    assert 2.0 * b[axis] == pytest.approx((energy(size) - energy(-size)) / (2 * size), rel=1e-2)


def test_the_system_is_that_of_numeric_derivatives() -> None:
    level, points, T = numeric.static(SMALL.height, SMALL.width, 1), make_points(2), pose(3)
    affine = np.array([-0.15, 4.0])
    x, y, idepth, grey, weight = points.astype(np.float64)
    at = numeric.project(T, x, y, idepth, INTRINSICS)
    inside = (at > 1.01).all(axis=1) & (at < (SMALL.width - 2.01, SMALL.height - 2.01)).all(axis=1)
    assert 200 < np.count_nonzero(inside) < len(inside)  # some leave the image
    at, x, y, idepth = at[inside], x[inside], y[inside], idepth[inside]
    grey, weight = grey[inside], weight[inside]
    seen = numeric.bilinear(level, at[:, 0], at[:, 1])
    residual = seen[:, 0] - affine[1] - np.exp(affine[0]) * grey
    moved = numeric.pose_derivatives(lambda T: numeric.project(T, x, y, idepth, INTRINSICS), T)
    J = np.empty((8, len(x)))
    J[:6] = moved[..., 0] * seen[:, 1] + moved[..., 1] * seen[:, 2]
    J[6], J[7] = -np.exp(affine[0]) * grey, -1.0
    w = weight * numeric.huber_weight(residual, HUBER)

    sums = accumulate(level, points[:, inside], T, affine)
    H, b = unpacked(sums)
    size = np.sqrt(np.diag((J * w) @ J.T))
    np.testing.assert_allclose(
        H / np.outer(size, size), (J * w) @ J.T / np.outer(size, size), atol=1e-4
    )
    cost = float(weight @ numeric.huber_cost(residual, HUBER))
    np.testing.assert_allclose(b / size, (J * w) @ residual / size, atol=1e-4 * np.sqrt(cost))
    assert sums[44] == pytest.approx(cost, rel=1e-4)
    assert tuple(sums[45:48]) == (len(x), len(x), 0)
    assert sums[48] == pytest.approx(weight.sum(), rel=1e-5)
    # The points that are left out of view add nothing.
    np.testing.assert_allclose(accumulate(level, points, T, affine), sums, rtol=1e-4, atol=1.0)


def test_points_behind_or_masked_add_nothing() -> None:
    level, points = numeric.ramp(SMALL.height, SMALL.width, 0.5, 0.3), make_points(4)
    behind = se3.exp([0, 0, -20.0, 0, 0, 0])
    assert not np.any(accumulate(level, points, behind, np.zeros(2)))
    assert not np.any(accumulate(level, points, np.eye(4), np.zeros(2), mask=np.zeros_like(MASK)))


def test_residuals_beyond_the_cutoff_cost_a_constant_and_pull_at_nothing() -> None:
    level, points = numeric.ramp(SMALL.height, SMALL.width, 0.0, 0.0), make_points(5)
    points[3] = 100.0
    points[3, :60] = 150.0  # 50 grey off
    sums = accumulate(level, points, np.eye(4), np.zeros(2), cutoff=np.float32(20.0))
    assert (sums[45], sums[46], sums[47]) == (240, 300, 60)
    limit = HUBER * (2 * 20.0 - HUBER)
    assert sums[44] == pytest.approx(limit * points[4, :60].sum(), rel=1e-5)
    assert sums[43] == pytest.approx(0.0, abs=1e-3)  # the slope for b: inliers agree exactly
    assert sums[35] == pytest.approx(points[4, 60:].sum(), rel=1e-5)


def test_flow_is_split_into_translation_and_rotation() -> None:
    points, out = make_points(6), np.empty(4)
    T = se3.exp([0.05, -0.02, 0.03, 0.01, -0.02, 0.015])
    x, y, idepth = points[:3].astype(np.float64)
    still = numeric.project(np.eye(4), x, y, idepth, INTRINSICS)

    def flow(T: Mat4) -> float:
        moved = numeric.project(T, x, y, idepth, INTRINSICS) - still
        return float(np.mean(np.sum(moved**2, axis=1)))

    R, t = np.ascontiguousarray(T[:3, :3]), np.ascontiguousarray(T[:3, 3])
    kf.mean_flow(points, points.shape[1], INTRINSICS, R, t, out)
    shift, turn = np.eye(4), np.eye(4)
    shift[:3, 3], turn[:3, :3] = t, R
    np.testing.assert_allclose(out, [flow(T), flow(shift), flow(turn), 1.0], rtol=1e-4)
