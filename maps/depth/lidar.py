# SPDX-License-Identifier: Apache-2.0
"""A depth image from one laser scan."""

from pathlib import Path

import numpy as np

from edge.errors import RecordingError
from edge.geometry import se3
from edge.geometry.camera import CameraModel
from edge.types import F32, F64, Mat4
from maps.depth import kernels_lidar

_RECORD_BYTES = 16  # x y z reflectance, float32
_NEAREST_M = 0.5  # nearer is the vehicle itself
_RADIUS_PER_SPACING = 1.6  # reaches the scan line above and the one below
_MIN_RADIUS_PX, _MAX_RADIUS_PX = 3, 24


def read_scan(path: Path) -> F32:
    """Points (n, 3) [m] of a velodyne file: x y z reflectance as float32, one after the other."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read ({error.strerror})") from None
    if len(data) % _RECORD_BYTES:
        raise RecordingError(f"{path}: {len(data)} bytes are no whole points; copy it again")
    points = np.frombuffer(data, np.dtype("<f4")).reshape(-1, 4)[:, :3]
    finite: F32 = points[np.isfinite(points).all(axis=1)].astype(np.float32)
    return finite


def lidar_depth(points: F32, T_cam_lidar: Mat4, camera: CameraModel) -> F32:
    """Depth along z (h, w) [m] in the raw image, 0 where no surface is known.

    points : (n, 3) of one scan, as the scanner sees them
    """
    in_camera = se3.transform(T_cam_lidar, points.astype(np.float64))
    in_camera = in_camera[in_camera[:, 2] > _NEAREST_M]
    depth = np.zeros((camera.height, camera.width), np.float32)
    pixels = _inside(in_camera, camera)
    if len(pixels) == 0:
        return depth
    u, v, z = pixels.T
    sparse = np.empty_like(depth)
    kernels_lidar.splat(np.ascontiguousarray(u), np.ascontiguousarray(v), z.copy(), sparse)
    kernels_lidar.densify(sparse, _radius(sparse), depth)
    return depth


def _inside(points: F64, camera: CameraModel) -> F64:
    """Raw pixels and depths (m, 3) of the points that fall into the image."""
    u, v = camera.project(points).T
    # What the lens does not see is no number, and in no image.
    inside = (u > -0.5) & (v > -0.5) & (u < camera.width - 0.5) & (v < camera.height - 0.5)
    pixels: F64 = np.column_stack((u, v, points[:, 2]))[inside]
    return pixels


def _radius(sparse: F32) -> int:
    """Half the window's side [px], by how far apart the scan's points are."""
    rows, columns = np.nonzero(sparse)
    area = (np.ptp(rows) + 1) * (np.ptp(columns) + 1)
    spacing = np.sqrt(area / len(rows))
    return int(np.clip(round(_RADIUS_PER_SPACING * spacing), _MIN_RADIUS_PX, _MAX_RADIUS_PX))
