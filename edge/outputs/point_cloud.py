# SPDX-License-Identifier: Apache-2.0
"""Writes the odometry's points in the map frame as a binary PLY file, keyframe by keyframe."""

from pathlib import Path
from typing import BinaryIO

import numpy as np

from edge.geometry import se3, sim3
from edge.geometry.camera import CameraModel
from edge.types import F64, U8, KeyframeResult, MapPose, Mat4

# Points less certain than this share of their depth make a cloud look like smoke.
MAX_DEPTH_SIGMA_SHARE = 0.05
_VERTEX = np.dtype(
    [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("red", "u1"), ("green", "u1"), ("blue", "u1")]
)
_COUNT_DIGITS = 12  # the number of points is known at the end, its place in the header before


class PointCloudWriter:
    """One PLY file; complete after `close`.

    Owned by the tracking thread.
    """

    def __init__(self, path: Path, camera: CameraModel) -> None:
        self._camera = camera
        self._count = 0
        self._file: BinaryIO = path.open("wb")
        self._file.write(_header(0))

    def add(self, keyframe: KeyframeResult, S_map_odom: sim3.Sim3) -> None:
        """Append the certain points of `keyframe`."""
        depth = keyframe.depth
        with np.errstate(divide="ignore", invalid="ignore"):
            share = depth.sigma / depth.inverse_depth
        good = (depth.inverse_depth > 0) & (share < MAX_DEPTH_SIGMA_SHARE)
        pixels = depth.pixels[good].astype(np.float64)
        rays = np.column_stack((self._camera.normalise(pixels), np.ones(len(pixels))))
        points_cam = rays / depth.inverse_depth[good, None].astype(np.float64)
        points_map = sim3.transform(S_map_odom, se3.transform(keyframe.T_odom_cam, points_cam))
        rows = np.empty(len(pixels), _VERTEX)
        rows["x"], rows["y"], rows["z"] = points_map.T
        grey = self._grey(keyframe.frame.image, pixels)
        rows["red"] = rows["green"] = rows["blue"] = grey
        self._file.write(rows.tobytes())
        self._count += len(rows)

    def close(self) -> None:
        """Write the number of points into the header."""
        if not self._file.closed:
            self._file.seek(0)
            self._file.write(_header(self._count))
            self._file.close()

    def _grey(self, image: U8, pixels: F64) -> U8:
        """Grey values (n,) of the raw image at ideal pixels (n, 2)."""
        raw = np.nan_to_num(self._camera.distort_pixels(pixels))
        u, v = np.rint(raw).astype(np.int64).T
        height, width = image.shape
        grey: U8 = image[np.clip(v, 0, height - 1), np.clip(u, 0, width - 1)]
        return grey


def map_from_odometry(pose: MapPose, T_odom_cam: Mat4) -> sim3.Sim3:
    """S_map_odom that the two poses of one frame tell."""
    R = pose.T_map_cam[:3, :3] @ T_odom_cam[:3, :3].T
    t = pose.T_map_cam[:3, 3] - pose.scale * (R @ T_odom_cam[:3, 3])
    return sim3.Sim3(pose.scale, R, t)


def _header(count: int) -> bytes:
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        "comment points seen by the odometry, metres in the map frame",
        f"element vertex {count:0{_COUNT_DIGITS}d}",
        "property float x",
        "property float y",
        "property float z",
        "property uchar red",
        "property uchar green",
        "property uchar blue",
        "end_header\n",
    ]
    return "\n".join(lines).encode("ascii")
