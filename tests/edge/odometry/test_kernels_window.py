# SPDX-License-Identifier: Apache-2.0
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import pytest

from edge.config.odometry import OdometryConfig
from edge.geometry import se3
from edge.odometry import kernels_schur as ks
from edge.odometry import kernels_window as kw
from edge.odometry.keyframe import Keyframe
from edge.odometry.system import (
    Packing,
    WindowSystem,
    relative_adjoints,
    relative_affines,
    relative_warps,
)
from edge.types import F32, F64, Frame
from tests.edge.odometry import numeric
from tests.edge.odometry.scenes import SMALL

INTRINSICS = np.array([SMALL.fx, SMALL.fy, SMALL.cx, SMALL.cy], np.float32)
MASK = np.ones((SMALL.height, SMALL.width), np.uint8)
HOSTS = np.repeat([0, 1], [40, 33]).astype(np.int32)
PARAMETERS = ["tx", "ty", "tz", "rx", "ry", "rz", "a", "b"]
NO_LIMIT = 1e12


@dataclass
class Problem:
    """Three frames, points in the first two; residuals in all but the hosts."""

    images: F32
    keyframes: list[Keyframe]
    points: F32
    config: OdometryConfig

    def __post_init__(self) -> None:
        self.system = WindowSystem(self.images, MASK, INTRINSICS, self.config)
        residual = np.full((3, len(HOSTS)), kw.INLIER, np.uint8)
        residual[HOSTS, np.arange(len(HOSTS))] = kw.UNUSED
        self.packing = self.system.pack(self.points, HOSTS, residual, self.keyframes)

    def energy(self) -> float:
        return self.system.linearise(self.packing, self.keyframes)

    def whole(self) -> tuple[F64, F64]:
        """H (24, 24) and b (24,) before the depths are eliminated."""
        self.energy()
        first = np.stack([k.affine_first for k in self.keyframes])
        now = np.stack([k.affine for k in self.keyframes])
        adjoint = relative_adjoints(relative_warps([k.T_first for k in self.keyframes]))
        H, b = np.empty((24, 24)), np.empty(24)
        affine = relative_affines(now, first)
        ks.stitch(self.packing.sums, adjoint.astype(np.float32), affine, H, b)
        return H, b


def make_keyframe(slot: int, rng: np.random.Generator) -> Keyframe:
    nothing = Frame(slot, slot, np.zeros((2, 2), np.uint8))
    keyframe = Keyframe(nothing, slot, se3.exp(rng.normal(0, 0.03, 6)), rng.normal(0, (0.1, 3.0)))
    keyframe.energy_limit = NO_LIMIT
    return keyframe


def make_problem(images: F32, *, moved: float, coherent: bool, **config: float) -> Problem:
    """`moved`: how far the state lies from the first estimates."""
    rng = np.random.default_rng(5)
    keyframes = [make_keyframe(slot, rng) for slot in range(3)]
    for keyframe in keyframes:
        keyframe.delta = moved * rng.normal(0, np.repeat((0.01, 0.05, 2.0), (6, 1, 1)))
    n = len(HOSTS)
    points = np.zeros((kw.POINT_ROWS, n), np.float32)
    points[kw.U] = rng.uniform(90, 125, n) if coherent else rng.uniform(28, 132, n)
    points[kw.V] = rng.uniform(70, 92, n) if coherent else rng.uniform(28, 92, n)
    points[kw.IDEPTH] = rng.uniform(0.3, 1.2, n)
    points[kw.GREY : kw.GREY + 8] = rng.uniform(70, 130, (8, n))
    points[kw.WEIGHT : kw.WEIGHT + 8] = rng.uniform(0.5, 1.0, (8, n))
    return Problem(images, keyframes, points, OdometryConfig(**config).resolved())


def residuals(problem: Problem, host: int, target: int) -> Iterator[tuple[F64, F64, F64, F64]]:
    """Per pattern pixel: residuals (n,), weights (n,), J (16, n) of host and target, J_depth (n,).

    The pattern moves with its centre, whose way is differentiated numerically.
    """
    table = problem.points[:, host == HOSTS].astype(np.float64)
    h, t = problem.keyframes[host], problem.keyframes[target]
    fx, fy, cx, cy = INTRINSICS.astype(np.float64)
    idepth = table[kw.IDEPTH]

    def ray(pu: float, pv: float) -> tuple[F64, F64]:
        return (table[kw.U] + pu - cx) / fx, (table[kw.V] + pv - cy) / fy

    def centre(T_t: F64, T_h: F64, d: F64) -> F64:
        return numeric.project(T_t @ se3.inverse(T_h), *ray(0, 0), d, INTRINSICS)

    moved = np.concatenate((
        numeric.pose_derivatives(lambda T: centre(t.T_first, T, idepth), h.T_first),
        numeric.pose_derivatives(lambda T: centre(T, h.T_first, idepth), t.T_first),
        numeric.derivative(lambda s: centre(t.T_first, h.T_first, idepth + s))[None],
    ))  # fmt: skip
    T_now = t.T_cam_odom @ se3.inverse(h.T_cam_odom)
    first = np.stack((h.affine_first, t.affine_first))
    for q in range(kw.PATTERN_SIZE):
        at = numeric.project(T_now, *ray(kw.PATTERN_U[q], kw.PATTERN_V[q]), idepth, INTRINSICS)
        seen = numeric.bilinear(problem.images[t.slot], at[:, 0], at[:, 1])
        colour = table[kw.GREY + q]

        def brightness(of: F64, seen: F64 = seen, colour: F64 = colour) -> F64:
            (a_h, b_h), (a_t, b_t) = of
            return seen[:, 0] - b_t - np.exp(a_t - a_h) * (colour - b_h)

        J = np.empty((17, len(colour)))
        steps = moved[..., 0] * seen[:, 1] + moved[..., 1] * seen[:, 2]
        J[0:6], J[8:14], J[16] = steps[:6], steps[6:12], steps[12]
        for row, unit in zip((6, 7, 14, 15), np.eye(4).reshape(4, 2, 2), strict=True):
            step = 1e-5 * unit
            J[row] = (brightness(first + step) - brightness(first - step)) / 2e-5
        r = brightness(np.stack((h.affine, t.affine)))
        scale2 = problem.config.gradient_scale_grey**2
        slope2 = seen[:, 1] ** 2 + seen[:, 2] ** 2
        w = (0.5 * (np.sqrt(scale2 / (scale2 + slope2)) + table[kw.WEIGHT + q])) ** 2
        yield r, w, J[:16], J[16]


def dense(problem: Problem) -> tuple[float, F64, F64]:
    """Energy, H and b over 24 frame unknowns and one depth of each point, in the points' order."""
    n, huber = len(HOSTS), problem.config.huber_grey
    H, b, energy = np.zeros((24 + n, 24 + n)), np.zeros(24 + n), 0.0
    for host in (0, 1):
        mine = np.flatnonzero(host == HOSTS)
        for target in range(3):
            if target == host:
                continue
            rows = np.r_[8 * host : 8 * host + 8, 8 * target : 8 * target + 8]
            for r, w, J, Jd in residuals(problem, host, target):
                energy += float(w @ numeric.huber_cost(r, huber))
                full = np.zeros((24 + n, len(mine)))
                full[rows] = J
                full[24 + mine, np.arange(len(mine))] = Jd
                wr = w * numeric.huber_weight(r, huber)
                H += (full * wr) @ full.T
                b += (full * wr) @ r
    return energy, H, b


def lanes(packing: Packing) -> np.ndarray:
    """Where each point, in the points' order, lies in the packing."""
    real = np.flatnonzero(packing.order >= 0)
    return real[np.argsort(packing.order[real])]


def static_images() -> F32:
    return np.stack([numeric.static(SMALL.height, SMALL.width, seed) for seed in range(3)])


@pytest.mark.parametrize("moved", [0.0, 1.0], ids=["at first estimates", "moved since"])
def test_the_system_is_that_of_numeric_derivatives_at_the_first_estimates(moved: float) -> None:
    problem = make_problem(static_images(), moved=moved, coherent=False)
    energy, H_dense, b_dense = dense(problem)
    H, b = problem.whole()
    packing, at = problem.packing, lanes(problem.packing)
    size = np.sqrt(np.diag(H_dense))
    scale = np.outer(size, size)

    assert problem.energy() == pytest.approx(energy, rel=1e-4)
    np.testing.assert_allclose((H - H_dense[:24, :24]) / scale[:24, :24], 0.0, atol=1e-4)
    np.testing.assert_allclose(
        (packing.W[:, at] - H_dense[:24, 24:]) / scale[:24, 24:], 0.0, atol=1e-4
    )
    np.testing.assert_allclose(packing.Hd[at], np.diag(H_dense)[24:], rtol=1e-3)
    slope = np.concatenate((b, packing.bd[at]))
    np.testing.assert_allclose((slope - b_dense) / size, 0.0, atol=1e-4 * np.sqrt(energy))


@pytest.mark.parametrize("frame", range(3), ids=["host", "host and target", "target"])
@pytest.mark.parametrize("axis", range(8), ids=PARAMETERS)
def test_b_is_half_of_the_slope_of_the_energy(frame: int, axis: int) -> None:
    problem = ramp_problem(1.0, -0.7 if axis == 5 else 0.7)
    _, b = problem.whole()
    size = 0.1 if axis == 7 else 1e-3

    def energy(step: float) -> float:
        keyframe = problem.keyframes[frame]
        keyframe.delta = step * np.eye(8)[axis]
        value = problem.energy()
        keyframe.delta = np.zeros(8)
        return value

    slope = (energy(size) - energy(-size)) / (2 * size)
    # The pattern turns and grows with its point, which derivatives at its centre leave out.
    assert 2.0 * b[8 * frame + axis] == pytest.approx(slope, rel=1e-1)


def test_bd_is_half_of_the_slope_of_the_energy() -> None:
    problem = ramp_problem(1.0, 0.7)
    problem.energy()
    bd = problem.packing.bd.copy()
    for lane in lanes(problem.packing)[::8]:
        depth, both = float(problem.packing.points[kw.IDEPTH, lane]), []
        for size in (3e-3, -3e-3):
            problem.packing.points[kw.IDEPTH, lane] = depth + size
            problem.energy()
            both.append(float(problem.packing.energy[:, lane].sum()))
        problem.packing.points[kw.IDEPTH, lane] = depth
        assert 2.0 * bd[lane] == pytest.approx((both[0] - both[1]) / 6e-3, rel=3e-2, abs=5.0)


def ramp_problem(du: float, dv: float) -> Problem:
    """Smooth in everything: exact interpolation, constant weights, residuals of one sign."""
    level = numeric.ramp(SMALL.height, SMALL.width, du, dv)
    images = np.stack((level, level, level))
    problem = make_problem(
        images, moved=0.0, coherent=True, gradient_scale_grey=1e6, huber_grey=60.0
    )
    problem.packing.points[kw.GREY : kw.GREY + 8] *= 0.1
    problem.packing.points[kw.GREY : kw.GREY + 8] += 60.0
    return problem


def test_jacobians_stay_at_the_first_estimates() -> None:
    # A ramp's gradient is the same everywhere: only geometry could change the system.
    level = numeric.ramp(SMALL.height, SMALL.width, 0.5, 0.35)
    problem = make_problem(
        np.stack((level, level, level)), moved=0.0, coherent=False, huber_grey=1e6
    )
    H_before, b_before = problem.whole()
    for keyframe in problem.keyframes:
        keyframe.delta[:6] = 0.01
        keyframe.delta[6:] = (0.05, 2.0)
    H, b = problem.whole()
    np.testing.assert_allclose(H, H_before, rtol=1e-5, atol=1e-6 * H.max())
    assert not np.allclose(b, b_before, rtol=1e-2)


def test_points_out_of_view_or_masked_are_outside() -> None:
    problem = make_problem(static_images(), moved=0.0, coherent=False)
    problem.packing.points[kw.U, 0] = 1.5  # its pattern reaches over the border
    problem.energy()
    assert set(problem.packing.state[1:, 0]) == {kw.OUTSIDE}
    assert problem.packing.state[0, 0] == kw.UNUSED
    assert not np.any(problem.packing.W[:, 0])
    assert problem.packing.Hd[0] == 0.0


def test_residuals_beyond_the_limit_are_outliers_and_pull_at_nothing() -> None:
    problem = make_problem(static_images(), moved=0.0, coherent=False)
    whole = problem.energy()
    energies = problem.packing.energy[problem.packing.state == kw.INLIER]
    limit = float(np.median(energies))
    for keyframe in problem.keyframes:
        keyframe.energy_limit = limit
    capped = problem.energy()
    state = problem.packing.state
    assert np.count_nonzero(state == kw.OUTLIER) == pytest.approx(len(energies) / 2, abs=1)
    assert capped == pytest.approx(np.minimum(energies, limit).sum(), rel=1e-5)
    assert capped < whole
    lost = np.all((state == kw.OUTLIER) | (state == kw.UNUSED), axis=0)
    assert np.any(lost & (problem.packing.order >= 0))
    assert not np.any(problem.packing.Hd[lost])


def test_padding_lanes_are_unused() -> None:
    problem = make_problem(static_images(), moved=0.0, coherent=False)
    problem.energy()
    padding = problem.packing.order < 0
    assert np.count_nonzero(padding) == 2 * 2 * kw.BLOCK - len(HOSTS)
    assert set(problem.packing.state[:, padding].ravel()) == {kw.UNUSED}
    assert not np.any(problem.packing.Hd[padding])
