# SPDX-License-Identifier: Apache-2.0
"""Where the points of a pool should appear from a pose, and how surely."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edge.config.relocalise import RelocaliseConfig
from edge.relocalise.pool import Pool, unpacked
from edge.types import F32, F64, Mat4, Mat6, Pinhole

Bools = NDArray[np.bool_]
_MIN_DEPTH = 1e-6
_BORDER_PX = 19  # no feature is found nearer to the border


class Projection(NamedTuple):
    """The pool's points (n) and rows (m) as seen from a pose."""

    centre: F64  # (n, 2) [px]
    depth: F64  # (n,) [m]; not positive behind the camera
    sigma_px: F64  # (n,) largest axis of the projected uncertainty, without the feature's own
    level: F32  # (m,) octave at which a row's patch should appear
    radius_px: F64  # (m,) window to look into; 0 where it should not be seen


class View(NamedTuple):
    """A pose from which to look; without a covariance it counts as exact."""

    T_map_cam: Mat4
    covariance: Mat6 | None
    camera: Pinhole


def project(
    pool: Pool,
    view: View,
    scale_factor: float,
    config: RelocaliseConfig,
    window_px: tuple[float, float],
) -> Projection:
    """Project a pool into a view.

    `window_px` are the least and the greatest window. A point that would need a greater one is
    left out: a match in it says no more than chance.
    """
    R, p = view.T_map_cam[:3, :3], view.T_map_cam[:3, 3]
    camera = view.camera
    ray = pool.xyz - p
    x, y, z = (ray @ R).T
    in_front = z > _MIN_DEPTH
    iz = 1.0 / np.where(in_front, z, 1.0)
    x, y = x * iz, y * iz
    centre = np.stack((camera.fx * x + camera.cx, camera.fy * y + camera.cy), axis=1)
    A = np.empty((len(ray), 2, 3))
    A[:, 0] = (camera.fx * iz)[:, None] * (R[:, 0] - x[:, None] * R[:, 2])
    A[:, 1] = (camera.fy * iz)[:, None] * (R[:, 1] - y[:, None] * R[:, 2])
    sigma_px = _largest_sigma(A, ray, pool.C, view.covariance)
    least, greatest = window_px
    window = np.maximum(least, config.guided_sigmas * sigma_px)
    wanted = in_front & _inside(centre, camera) & (window <= greatest)

    pixels = pool.pixel_m * (camera.fx * iz)[pool.point]
    level = np.log(np.maximum(pixels, 1e-3)) / np.log(scale_factor)
    unit = ray / np.linalg.norm(ray, axis=1, keepdims=True)
    facing = np.einsum("ij,ij->i", unit[pool.point], pool.ray)
    seen = wanted[pool.point] & (facing >= np.cos(np.deg2rad(config.guided_max_view_deg)))
    # Features of a higher octave are placed less exactly.
    radius = np.where(seen, window[pool.point] * np.maximum(1.0, pixels), 0.0)
    return Projection(centre, z, sigma_px, level.astype(np.float32), radius)


def _inside(centre: F64, camera: Pinhole) -> Bools:
    u, v = centre.T
    far_u, far_v = camera.width - 1 - _BORDER_PX, camera.height - 1 - _BORDER_PX
    inside = (u >= _BORDER_PX) & (u <= far_u) & (v >= _BORDER_PX) & (v <= far_v)
    return np.asarray(inside, np.bool_)


def _largest_sigma(A: F64, ray: F64, C: F64, covariance: Mat6 | None) -> F64:
    """Standard deviation (n,) along the longest axis of each projected uncertainty [px].

    A    (n, 2, 3)  derivative of the pixel by the point
    ray  (n, 3)     from the camera to the point, map axes
    """
    S = A @ unpacked(C) @ A.transpose(0, 2, 1)
    if covariance is not None:
        # The pixel moves against the camera: by -v - w x ray.
        J = np.concatenate((-A, np.cross(A, ray[:, None, :])), axis=2)
        S += J @ covariance @ J.transpose(0, 2, 1)
    mean = 0.5 * (S[:, 0, 0] + S[:, 1, 1])
    half = np.hypot(0.5 * (S[:, 0, 0] - S[:, 1, 1]), S[:, 0, 1])
    return np.sqrt(np.maximum(mean + half, 0.0))
