# SPDX-License-Identifier: Apache-2.0
"""The window's points as others see them: in the newest keyframe, as depths, in space."""

import numpy as np

from edge.geometry import se3
from edge.odometry import kernels_window as kw
from edge.odometry.kernels_reference import project_points
from edge.odometry.lens import as_calibrated
from edge.odometry.system import relative_warps
from edge.odometry.window import Window
from edge.types import F32, U8, Bools, DepthSamples


def project(window: Window, target: int = -1) -> F32:
    """All active points in a keyframe, the newest one if none is named, (3, n): u, v, 1 / depth."""
    warps = relative_warps([k.T_cam_odom for k in window.keyframes]).astype(np.float32)
    projected = np.empty((3, window.points.shape[1]), np.float32)
    target %= len(window.keyframes)
    project_points(window.points, window.host, warps, window.intrinsics, target, projected)
    return projected


def not_newest(window: Window) -> Bools:
    """Which points (n,) the newest keyframe does not host."""
    return np.asarray(window.host != len(window.keyframes) - 1)


def depth_samples(
    window: Window, projected: F32, use: Bools, energy: float, scale: float
) -> DepthSamples:
    """Depths of the projected points (3, n) where `use` (n,) says so.

    `energy` is a residual's mean [grey^2], `scale` full-size pixels per pixel of level 0.
    """
    noise_grey = np.sqrt(max(energy, 1.0) / kw.PATTERN_SIZE)
    chosen = use & (projected[2] > 0)
    information = np.maximum(window.depth_information[chosen], 1e-6)
    ratio = projected[2, chosen] / window.points[kw.IDEPTH, chosen]
    radial = window.keyframes[-1].undistortion.radial
    told = as_calibrated(projected[:2, chosen], window.pinhole, radial)
    pixels = (told.T + np.float32(0.5)) * np.float32(scale) - np.float32(0.5)
    samples = DepthSamples(
        pixels=np.ascontiguousarray(pixels, np.float32),
        inverse_depth=projected[2, chosen].copy(),
        sigma=(noise_grey / np.sqrt(information) * ratio).astype(np.float32),
    )
    for array in (samples.pixels, samples.inverse_depth, samples.sigma):
        array.flags.writeable = False
    return samples


def points_of(window: Window) -> tuple[F32, U8]:
    """Positions of the active points in the odometry frame (n, 3), and their grey (n,) uint8."""
    p = window.pinhole
    xyz = np.zeros((window.points.shape[1], 3), np.float32)
    for index, keyframe in enumerate(window.keyframes):
        mine = window.host == index
        u, v, idepth = window.points[:3, mine].astype(np.float64)
        rays = np.column_stack(((u - p.cx) / p.fx, (v - p.cy) / p.fy, np.ones(len(u))))
        xyz[mine] = se3.transform(keyframe.T_odom_cam, rays / idepth[:, None])
    grey = np.clip(window.points[kw.GREY + kw.PATTERN_CENTRE], 0, 255).astype(np.uint8)
    return xyz, grey
