# SPDX-License-Identifier: Apache-2.0
"""A drive along a painted wall: images by homography, poses and depths exact."""

from pathlib import Path

import cv2
import numpy as np

from edge.geometry import se3
from edge.geometry.camera import CameraModel
from edge.types import F64, U8
from tests.maps.drive_folder import KnownView, write_drive

CAMERA = CameraModel(320, 240, 260.0, 262.0, 161.0, 118.5)
WALL_Z_M = 2.0
PIXELS_PER_M = 260.0
WALL_SIZE_PX = (1200, 800)  # its middle lies at x = y = 0


def wall(seed: int = 0) -> U8:
    """The paint: blotches of several sizes, and sharp shapes."""
    rng = np.random.default_rng(seed)
    width, height = WALL_SIZE_PX
    image = np.full((height, width), 128.0, np.float32)
    for cell in (4, 9, 25, 80):
        noise = rng.normal(0.0, 12.0, (height // cell + 2, width // cell + 2)).astype(np.float32)
        image += cv2.resize(noise, (width, height), interpolation=cv2.INTER_CUBIC)
    for _ in range(150):
        centre = rng.uniform(0.0, 1.0, 2) * WALL_SIZE_PX
        corners = centre + rng.uniform(-30.0, 30.0, (4, 2))
        cv2.fillPoly(image, [np.round(corners).astype(np.int32)], float(rng.uniform(10.0, 245.0)))
    return np.clip(image, 0, 255).astype(np.uint8)


def poses(n: int, seed: int = 0) -> F64:
    """T_world_cam (n, 4, 4): sideways along the wall, with a hand's wobble."""
    rng = np.random.default_rng([seed, 1])
    made = []
    for i in range(n):
        wobble = rng.normal(0.0, 0.03, 6)
        wobble[0] += 0.12 * (i - 0.5 * (n - 1))
        made.append(se3.exp(wobble))
    return np.array(made)


def picture(paint: U8, T_world_cam: F64, camera: CameraModel = CAMERA) -> U8:
    """What an ideal camera sees of the wall."""
    T = se3.inverse(T_world_cam)
    K = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1.0]])
    # Wall pixel (u, v, 1) to world: x = (u - w / 2) / scale, on the plane z.
    w, h = WALL_SIZE_PX
    s = 1.0 / PIXELS_PER_M
    world = np.array([[s, 0, -0.5 * w * s], [0, s, -0.5 * h * s], [0, 0, WALL_Z_M]])
    H = K @ (T[:3, :3] @ world + np.outer(T[:3, 3], [0, 0, 1]))
    size = camera.width, camera.height
    return np.asarray(cv2.warpPerspective(paint, H, size, flags=cv2.INTER_AREA), np.uint8)


def depth(T_world_cam: F64, camera: CameraModel = CAMERA) -> F64:
    """Depth (h, w) along z of the wall."""
    v, u = np.mgrid[: camera.height, : camera.width]
    rays = np.stack(
        ((u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u, float))
    )
    along = np.einsum("i,ihw->hw", T_world_cam[2, :3], rays)
    result: F64 = (WALL_Z_M - T_world_cam[2, 3]) / along
    return result


def write_wall_drive(
    folder: Path, n: int = 6, *, seed: int = 0, with_depth: bool = False, with_poses: bool = True
) -> Path:
    """Write the drive as a sequence folder."""
    paint = wall(seed)
    views = (
        KnownView(picture(paint, T), T, depth(T) if with_depth else None) for T in poses(n, seed)
    )
    return write_drive(folder, CAMERA, views, first_s=100.0, with_poses=with_poses)
