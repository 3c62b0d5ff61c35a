# SPDX-License-Identifier: Apache-2.0
"""Stereo rectification: both cameras turned in place so that rows of their images correspond.

After Fusiello, Trucco & Verri (2000): the common x axis is the baseline, the common z axis lies
as near as it can to both optical axes, and both share one pinhole, so that a point at infinity
has no disparity and depth along the common z axis is `fx * baseline_m / (u_left - u_right)`.
"""

from dataclasses import dataclass

import numpy as np

from edge.errors import ConfigError
from edge.geometry.camera import CameraModel
from edge.types import F64, Mat4, Pinhole


@dataclass(frozen=True, slots=True, eq=False)
class StereoRectification:
    """A stereo pair's common pinhole, and the rotation of each camera to it."""

    left: CameraModel
    right: CameraModel
    pinhole: Pinhole
    R_rect_left: F64  # (3, 3)
    R_rect_right: F64  # (3, 3)
    baseline_m: float

    def rectify_left(self, pixels: F64) -> F64:
        """Rectified pixels (n, 2) of raw pixels (n, 2) of the left camera; nan off its field."""
        return _rectify(self.left, self.R_rect_left, self.pinhole, pixels)

    def rectify_right(self, pixels: F64) -> F64:
        """Rectified pixels (n, 2) of raw pixels (n, 2) of the right camera."""
        return _rectify(self.right, self.R_rect_right, self.pinhole, pixels)


def rectify(left: CameraModel, right: CameraModel, T_left_right: Mat4) -> StereoRectification:
    """Rectification of two cameras; T_left_right takes points of the right one to the left one."""
    t = T_left_right[:3, 3]
    baseline_m = float(np.linalg.norm(t))
    if not t[0] > 0.5 * baseline_m > 0.0:
        message = "T_left_right: the right camera does not lie to the right of the left one"
        raise ConfigError(f"{message}; swap the cameras or take the inverse")
    x = t / baseline_m
    z = T_left_right[:3, 2] + (0.0, 0.0, 1.0)
    y = np.cross(z, x)
    y /= np.linalg.norm(y)
    R_rect_left = np.stack((x, y, np.cross(x, y)))
    R_rect_right = R_rect_left @ T_left_right[:3, :3]
    pinhole = _common_pinhole(left, right, R_rect_left, R_rect_right)
    return StereoRectification(left, right, pinhole, R_rect_left, R_rect_right, baseline_m)


def _common_pinhole(
    left: CameraModel, right: CameraModel, R_rect_left: F64, R_rect_right: F64
) -> Pinhole:
    """Pinhole of the left image's size and the mean focal length, centred on both images."""
    f = float(np.mean([left.fx, left.fy, right.fx, right.fy]))
    unit = Pinhole(left.width, left.height, 1.0, 1.0, 0.0, 0.0)
    centres = [
        _rectify(camera, R, unit, np.array([[(camera.width - 1) / 2, (camera.height - 1) / 2]]))
        for camera, R in ((left, R_rect_left), (right, R_rect_right))
    ]
    x, y = np.mean(centres, axis=(0, 1))
    cx, cy = (left.width - 1) / 2 - f * x, (left.height - 1) / 2 - f * y
    return Pinhole(left.width, left.height, f, f, float(cx), float(cy))


def _rectify(camera: CameraModel, R_rect_cam: F64, pinhole: Pinhole, pixels: F64) -> F64:
    ideal = camera.undistort(camera.normalise(pixels))
    rays = np.column_stack((ideal, np.ones(len(ideal)))) @ R_rect_cam.T
    focal, centre = (pinhole.fx, pinhole.fy), (pinhole.cx, pinhole.cy)
    return np.asarray(rays[:, :2] / rays[:, 2:] * focal + centre, np.float64)
