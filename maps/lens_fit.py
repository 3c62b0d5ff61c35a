# SPDX-License-Identifier: Apache-2.0
"""Fits a lens and points to tracks whose views have given poses: bundle adjustment without poses.

Residuals are taken in the image as it came, so that a lens that draws everything together gains
nothing by it.
"""

from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from edge.geometry import distortion
from edge.geometry.camera import CameraModel
from edge.types import F64, I32

I64: TypeAlias = NDArray[np.int64]

# k1 and k2 added, focal length as ln of a factor, centre moved [px]: in the order of a fit, which
# lets the first so many of them free.
SIZE = 5
# How far off a calibration may be.
_PRIOR_SIGMA = np.array([0.2, 0.2, 0.03, 10.0, 10.0])
_SLOPE_STEP = np.array([1e-5, 1e-5, 1e-6, 1e-3, 1e-3])
_CAUCHY2 = 4.0  # squared scale of the robust cost [sigmas^2]
_MIN_DEPTH = 1e-6
_ROUNDS = 12
_ENOUGH_GAIN = 1e-5
_FIRST_DAMPING = 1e-4
_MAX_DAMPING = 1e3


class Sightings(NamedTuple):
    """Observations of points by one camera, sorted by point."""

    offsets: I64  # (n + 1,)
    view: I32  # (m,) of the poses
    raw: F64  # (m, 2) pixels of the image as it came
    sigma: F64  # (m,) [px]
    xyz: F64  # (n, 3) first guess of the points
    T_cam_map: F64  # (v, 4, 4)

    def some(self, points: I64) -> "Sightings":
        """Return the sightings of `points` (k,) alone."""
        counts = np.diff(self.offsets)[points]
        ends = np.concatenate(([0], np.cumsum(counts)))
        rows = np.arange(ends[-1]) + np.repeat(self.offsets[points] - ends[:-1], counts)
        columns = (self.view[rows], self.raw[rows], self.sigma[rows])
        return Sightings(ends, *columns, self.xyz[points], self.T_cam_map)


class LensFit(NamedTuple):
    """A lens with the points that go best with it."""

    theta: F64  # (5,)
    cost: float  # robust, over all sightings


def lens_with(camera: CameraModel, theta: F64) -> CameraModel:
    """Camera changed by theta (5,); ConfigError where there is no such lens."""
    model, k = camera.distortion_model, list(camera.distortion)
    if model == distortion.NONE and np.any(theta[:2]):
        model, k = distortion.RADTAN, [0.0] * 4
    if k:
        k[0] += float(theta[0])
        k[1] += float(theta[1])
    focal = float(np.exp(theta[2]))
    return CameraModel(
        camera.width,
        camera.height,
        camera.fx * focal,
        camera.fy * focal,
        camera.cx + float(theta[3]),
        camera.cy + float(theta[4]),
        distortion_model=model,
        distortion=tuple(k),
    )


def slopes(camera: CameraModel, theta: F64, ideal: F64, free: int) -> F64:
    """How raw pixels of `ideal` (m, 2), normalised points, move by the lens: (m, 2, free)."""
    here = _through(lens_with(camera, theta), ideal)
    out = np.empty((len(ideal), 2, free))
    for k in range(free):
        ahead = theta.copy()
        ahead[k] += _SLOPE_STEP[k]
        out[:, :, k] = (_through(lens_with(camera, ahead), ideal) - here) / _SLOPE_STEP[k]
    return out


def fit(sightings: Sightings, camera: CameraModel, theta: F64, free: int) -> LensFit:
    """Best points, and the best lens near `theta` with its first `free` parameters let free."""
    theta, xyz = theta.copy(), sightings.xyz.copy()
    prior = np.diag(1.0 / _PRIOR_SIGMA[:free] ** 2)
    system, damping = _linearised(sightings, xyz, camera, theta, free), _FIRST_DAMPING
    for _ in range(_ROUNDS):
        V = system.V + (damping * system.V + _MIN_DEPTH) * np.eye(3)
        WV = system.W @ np.linalg.inv(V)
        information = system.H + prior - np.einsum("nkj,nlj->kl", WV, system.W)
        b = system.b - prior @ theta[:free] - np.einsum("nkj,nj->k", WV, system.g)
        step = np.linalg.solve(information, b) if free else b
        rest = system.g - np.einsum("nkj,k->nj", system.W, step)
        moved, bent = xyz + np.linalg.solve(V, rest[:, :, None])[:, :, 0], theta.copy()
        bent[:free] += step
        cost = _cost(_residual(sightings, moved, lens_with(camera, bent)))
        if cost > system.cost:
            damping *= 10.0
            if damping > _MAX_DAMPING:
                break
            continue
        done = system.cost - cost < _ENOUGH_GAIN * cost
        xyz, theta, damping = moved, bent, 0.1 * damping
        system = _linearised(sightings, xyz, camera, theta, free)
        if done:
            break
    return LensFit(theta, system.cost)


class _System(NamedTuple):
    """Gauss-Newton system of the sightings: lens, points, and what couples them."""

    cost: float
    H: F64  # (k, k)
    b: F64  # (k,)
    V: F64  # (n, 3, 3)
    g: F64  # (n, 3)
    W: F64  # (n, k, 3)


def _linearised(
    sightings: Sightings, xyz: F64, camera: CameraModel, theta: F64, free: int
) -> _System:
    now = lens_with(camera, theta)
    local = in_camera(sightings, xyz)
    ideal = local[:, :2] / local[:, 2:]
    r = (sightings.raw - _through(now, ideal)) / sightings.sigma[:, None]
    square = np.sum(r * r, axis=1)
    root = 1.0 / np.sqrt(1.0 + square / _CAUCHY2)
    scale = (root / sightings.sigma)[:, None, None]
    bend = distortion.jacobian(now.distortion_model, now.distortion, ideal)
    by_local = np.zeros((len(r), 2, 3))
    by_local[:, 0, 0] = by_local[:, 1, 1] = 1.0 / local[:, 2]
    by_local[:, :, 2] = -ideal / local[:, 2:]
    R = sightings.T_cam_map[sightings.view, :3, :3]
    A = scale * np.array((now.fx, now.fy))[:, None] * (bend @ by_local @ R)
    L = scale * slopes(camera, theta, ideal, free)
    r *= root[:, None]
    by_point = sightings.offsets[:-1]
    return _System(
        _robust(square),
        np.einsum("mrk,mrl->kl", L, L),
        np.einsum("mrk,mr->k", L, r),
        np.add.reduceat(np.einsum("mri,mrj->mij", A, A), by_point, axis=0),
        np.add.reduceat(np.einsum("mri,mr->mi", A, r), by_point, axis=0),
        np.add.reduceat(np.einsum("mrk,mrj->mkj", L, A), by_point, axis=0),
    )


def in_camera(sightings: Sightings, xyz: F64) -> F64:
    """Camera coordinates (m, 3) of the point of each sighting."""
    T = sightings.T_cam_map[sightings.view]
    x = np.repeat(xyz, np.diff(sightings.offsets), axis=0)
    local = np.einsum("mij,mj->mi", T[:, :3, :3], x) + T[:, :3, 3]
    local[:, 2] = np.maximum(local[:, 2], _MIN_DEPTH)
    return np.asarray(local, np.float64)


def _through(camera: CameraModel, ideal: F64) -> F64:
    return camera.denormalise(camera.distort(ideal))


def _residual(sightings: Sightings, xyz: F64, camera: CameraModel) -> F64:
    local = in_camera(sightings, xyz)
    seen = _through(camera, local[:, :2] / local[:, 2:])
    return np.asarray((sightings.raw - seen) / sightings.sigma[:, None], np.float64)


def _cost(residual: F64) -> float:
    return _robust(np.sum(residual * residual, axis=1))


def _robust(square: F64) -> float:
    return float(_CAUCHY2 * np.log1p(square / _CAUCHY2).sum())
