# SPDX-License-Identifier: Apache-2.0
"""What kernels should give, slowly, in float64 and without a single formula for a derivative."""

from collections.abc import Callable

import numpy as np

from edge.geometry import se3
from edge.types import F32, F64, Mat4


def bilinear(level: F32, u: F64, v: F64) -> F64:
    """Channels (..., 3) of a level image between its pixels."""
    x0, y0 = np.floor(u).astype(int), np.floor(v).astype(int)
    a, b = (u - x0)[..., None], (v - y0)[..., None]
    image = level.astype(np.float64)
    top = (1 - a) * image[y0, x0] + a * image[y0, x0 + 1]
    low = (1 - a) * image[y0 + 1, x0] + a * image[y0 + 1, x0 + 1]
    return np.asarray((1 - b) * top + b * low)


def project(T: Mat4, x: F64, y: F64, idepth: F64, intrinsics: F32) -> F64:
    """Pixels (..., 2) of rays (x, y, 1) with inverse depths, seen by another camera."""
    fx, fy, cx, cy = intrinsics.astype(np.float64)
    rays = np.stack((x, y, np.ones_like(x)), axis=-1)
    p = rays @ T[:3, :3].T + idepth[..., None] * T[:3, 3]
    return np.stack((fx * p[..., 0] / p[..., 2] + cx, fy * p[..., 1] / p[..., 2] + cy), axis=-1)


def derivative(function: Callable[[float], F64], step: float = 1e-6) -> F64:
    """Central difference of a smooth function at zero."""
    return np.asarray((function(step) - function(-step)) / (2.0 * step))


def pose_derivatives(function: Callable[[Mat4], F64], T: Mat4) -> F64:
    """Derivatives (6, ...) with respect to the twist on the left of T."""

    def along(axis: int) -> F64:
        return derivative(lambda s: function(se3.exp(s * np.eye(6)[axis]) @ T))

    return np.stack([along(axis) for axis in range(6)])


def huber_weight(residual: F64, huber: float) -> F64:
    """Weight of each residual in the Gauss-Newton system of the Huber cost."""
    return np.asarray(np.minimum(1.0, huber / np.maximum(np.abs(residual), 1e-12)))


def huber_cost(residual: F64, huber: float) -> F64:
    """r^2 inside, 2 huber |r| - huber^2 outside."""
    size = np.abs(residual)
    return np.asarray(np.where(size < huber, size**2, 2.0 * huber * size - huber**2))


def ramp(height: int, width: int, du: float, dv: float) -> F32:
    """Level image whose bilinear interpolation is exact: grey rises evenly all over."""
    v, u = np.mgrid[:height, :width]
    level = np.empty((height, width, 3), np.float32)
    level[..., 0] = 100.0 + du * (u - width / 2) + dv * (v - height / 2)
    level[..., 1], level[..., 2] = du, dv
    return level


def static(height: int, width: int, seed: int) -> F32:
    """Level image of unrelated random channels: every wrong address shows."""
    rng = np.random.default_rng(seed)
    level = rng.normal(0.0, 10.0, (height, width, 3)).astype(np.float32)
    level[..., 0] += 100.0
    return level
