# SPDX-License-Identifier: Apache-2.0
"""Where the points of a pool should appear from a pose, and how surely."""

import math
from typing import NamedTuple

import numpy as np

from edge.config.relocalise import RelocaliseConfig
from edge.geometry.camera import CameraModel
from edge.relocalise import kernels_projection
from edge.relocalise.correspondences import parts_of
from edge.relocalise.lens import magnification
from edge.relocalise.pool import Pool
from edge.types import F32, F64, Mat4, Mat6

_BORDER_PX = 19  # no feature is found nearer to the border


class Projection(NamedTuple):
    """The pool's points (n) and rows (m) as seen from a pose."""

    centre: F64  # (n, 2) [px]
    depth: F64  # (n,) [m]; not positive behind the camera
    sigma_px: F64  # (n,) longest axis of what is uncertain, without the feature; 0 out of view
    level: F32  # (m,) octave at which a row's patch should appear
    radius_px: F64  # (m,) window to look into; 0 where it should not be seen


class View(NamedTuple):
    """A pose from which to look; without a covariance it counts as exact."""

    T_map_cam: Mat4
    covariance: Mat6 | None
    camera: CameraModel


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
    R, p = parts_of(view.T_map_cam)
    camera = view.camera.pinhole
    n, m = len(pool.xyz), len(pool.point)
    centre, depth, sigma_px, window = np.empty((n, 2)), np.empty(n), np.empty(n), np.empty(n)
    level, radius = np.empty(m, np.float32), np.empty(m)
    uncertain = np.zeros((6, 6)) if view.covariance is None else np.array(view.covariance)
    kernels_projection.project_points(
        pool.xyz, pool.C, R, p, uncertain, camera, float(_BORDER_PX), config.guided_sigmas,
        *window_px, centre, depth, sigma_px, window,
    )  # fmt: skip
    # Out of view it is of no use, and the lens model none.
    visible = np.where(window[:, None] > 0.0, centre, (camera.cx, camera.cy))
    stretch = magnification(view.camera, view.camera.normalise(visible))
    least_cosine = math.cos(math.radians(config.guided_max_view_deg))
    kernels_projection.project_rows(
        pool.xyz, p, pool.point, pool.ray, pool.pixel_m, depth, window, stretch,
        camera.fx, math.log(scale_factor), least_cosine, level, radius,
    )  # fmt: skip
    return Projection(centre, depth, sigma_px, level, radius)
