# SPDX-License-Identifier: Apache-2.0
from typing import NamedTuple

import numpy as np
import pytest

from edge.geometry import se3
from edge.odometry import kernels_start as ks
from edge.types import F64, U8
from tests.edge.odometry import numeric

M, N = 3, 40
NORMALISED = np.array([1.0, 1.0, 0.0, 0.0], np.float32)


class Sums(NamedTuple):
    cost: float
    H: F64
    b: F64
    Hd: F64
    bd: F64
    W: F64
    squared: F64


class Case(NamedTuple):
    rays: F64
    idepth: F64
    observed: F64
    seen: U8
    poses: list[F64]


def make_case() -> Case:
    rng = np.random.default_rng(0)
    seen = (rng.uniform(size=(M, N)) < 0.8).astype(np.uint8)
    poses = [se3.exp(rng.normal(0.0, 0.05, 6)) for _ in range(M)]
    rays = rng.uniform(-0.5, 0.5, (N, 2))
    idepth = rng.uniform(0.2, 1.5, N)
    observed = np.stack([project(T, rays, idepth) for T in poses])
    return Case(rays, idepth, observed + rng.normal(0.0, 0.01, observed.shape), seen, poses)


def project(T: F64, rays: F64, idepth: F64) -> F64:
    return numeric.project(T, rays[:, 0], rays[:, 1], idepth, NORMALISED)


def accumulate(case: Case, huber: float) -> Sums:
    T = np.stack(case.poses)
    out = Sums(
        0.0,
        *(np.empty(shape) for shape in ((6 * M, 6 * M), 6 * M, N, N, (6 * M, N), (M, N))),
    )
    R, t = np.ascontiguousarray(T[:, :3, :3]), np.ascontiguousarray(T[:, :3, 3])
    cost = ks.accumulate(case.rays, case.idepth, case.observed, case.seen, R, t, huber, *out[1:])
    return out._replace(cost=cost)


@pytest.mark.parametrize("huber", [1e3, 0.01], ids=["squared", "robust"])
def test_the_system_is_that_of_numeric_derivatives(huber: float) -> None:
    case = make_case()
    sums = accumulate(case, huber)
    H, b, W = np.zeros((6 * M, 6 * M)), np.zeros(6 * M), np.zeros((6 * M, N))
    Hd, bd, cost = np.zeros(N), np.zeros(N), 0.0
    for m, T in enumerate(case.poses):
        rows = slice(6 * m, 6 * m + 6)
        J = numeric.pose_derivatives(lambda T: project(T, case.rays, case.idepth), T)
        Jd = numeric.derivative(lambda s, T=T: project(T, case.rays, case.idepth + s))
        r = project(T, case.rays, case.idepth) - case.observed[m]
        length = np.linalg.norm(r, axis=1)
        cost += float(case.seen[m] @ numeric.huber_cost(length, huber))
        w = case.seen[m] * numeric.huber_weight(length, huber)
        H[rows, rows] = np.einsum("inc,n,jnc->ij", J, w, J)
        b[rows] = np.einsum("inc,n,nc->i", J, w, r)
        W[rows] = np.einsum("inc,n,nc->in", J, w, Jd)
        Hd += w * np.sum(Jd * Jd, axis=1)
        bd += w * np.sum(Jd * r, axis=1)
        np.testing.assert_allclose(sums.squared[m], case.seen[m] * length**2, atol=1e-12)
    assert sums.cost == pytest.approx(cost, rel=1e-9)
    for got, wanted in ((sums.H, H), (sums.b, b), (sums.W, W), (sums.Hd, Hd), (sums.bd, bd)):
        np.testing.assert_allclose(got, wanted, rtol=1e-5, atol=1e-7)


def test_points_behind_the_camera_cost_but_do_not_pull() -> None:
    case = make_case()
    case.poses[0][:] = se3.exp([0, 0, -50.0, 0, 0, 0])
    sums = accumulate(case, 0.01)
    assert not np.any(sums.H[:6, :6])
    assert not np.any(sums.b[:6])
    assert np.all(sums.squared[0][case.seen[0] > 0] > 1.0)
    assert sums.cost >= 4 * 0.01**2 * np.count_nonzero(case.seen[0])


def test_unseen_corners_count_nothing() -> None:
    case = make_case()
    nothing = accumulate(case._replace(seen=np.zeros_like(case.seen)), 1.0)
    assert nothing.cost == 0.0
    assert not any(np.any(part) for part in nothing[1:])
