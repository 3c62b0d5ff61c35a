# SPDX-License-Identifier: Apache-2.0
"""A walk past posters that hang at different distances: exact poses, depths and a marker."""

from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from edge.geometry import se3
from edge.geometry.camera import CameraModel
from edge.types import F32, F64, U8
from tests.maps.drive_folder import KnownView, write_drive
from tests.maps.wall_drive import wall

CAMERA = CameraModel(320, 240, 260.0, 262.0, 161.0, 118.5)
MARKER_SIDE_M = 0.3
MARKER_NUMBER = 7
_MARKER_PX = 400  # of its side; a white border of a quarter is around it


class Poster(NamedTuple):
    """A picture that faces the cameras."""

    paint: U8
    x: float  # of its upper left corner
    y: float
    z: float
    metre_px: float


def marker() -> U8:
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    inner = cv2.aruco.generateImageMarker(dictionary, MARKER_NUMBER, _MARKER_PX)
    border = _MARKER_PX // 4
    return cv2.copyMakeBorder(inner, *(border,) * 4, cv2.BORDER_CONSTANT, value=255)


def posters(seed: int = 0) -> list[Poster]:
    """Far ones first."""
    paint = wall(seed)
    other = wall(seed + 1)
    return [
        Poster(paint, -2.4, -1.6, 2.6, 250.0),
        Poster(other[:400, :500], -1.3, -0.8, 2.1, 500.0),
        Poster(other[400:, 500:900], 0.5, 0.0, 1.7, 500.0),
        Poster(marker(), -0.25, -0.35, 1.9, _MARKER_PX / MARKER_SIDE_M),
    ]


def path(n: int, seed: int = 0) -> F64:
    """T_world_cam (n, 4, 4): sideways, turning towards the middle, with a hand's wobble."""
    rng = np.random.default_rng([seed, 3])
    made = []
    for i in range(n):
        x = 1.3 * (i / max(n - 1, 1) - 0.5)
        wobble = rng.normal(0.0, 0.02, 6)
        made.append(se3.exp([x, 0.1 * np.sin(3.0 * x), 0, 0, -0.4 * x, 0]) @ se3.exp(wobble))
    return np.array(made)


def picture(hung: list[Poster], T_world_cam: F64, camera: CameraModel = CAMERA) -> tuple[U8, F32]:
    """Image and depth (h, w) [m] of an ideal camera."""
    T = se3.inverse(T_world_cam)
    K = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1.0]])
    size = (camera.width, camera.height)
    image = np.zeros(size[::-1], np.uint8)
    depth = np.zeros(size[::-1], np.float32)
    v, u = np.mgrid[: camera.height, : camera.width]
    rays = np.stack(((u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)))
    along = np.einsum("i,ihw->hw", T_world_cam[2, :3], rays)
    for paint, x, y, z, metre_px in hung:
        s = 1.0 / metre_px
        to_world = np.array([[s, 0, x + 0.5 * s], [0, s, y + 0.5 * s], [0, 0, z]])
        H = K @ (T[:3, :3] @ to_world + np.outer(T[:3, 3], [0, 0, 1]))
        # Drawn at twice the size and averaged, so that edges of posters are not ragged.
        double = np.array([[2.0, 0, 0.5], [0, 2.0, 0.5], [0, 0, 1.0]]) @ H
        twice = (2 * size[0], 2 * size[1])
        drawn = cv2.warpPerspective(paint, double, twice, flags=cv2.INTER_LINEAR)
        mask = cv2.warpPerspective(np.full_like(paint, 255), double, twice)
        cover = cv2.resize(mask, size, interpolation=cv2.INTER_AREA).astype(np.float32) / 255.0
        shown = cv2.resize(drawn, size, interpolation=cv2.INTER_AREA)
        # What is outside the poster was drawn black, and counts by the share that it covers.
        image = np.clip(image * (1.0 - cover) + shown, 0, 255).astype(np.uint8)
        depth = np.where(cover > 0.5, (z - T_world_cam[2, 3]) / along, depth).astype(np.float32)
    return image, depth


def bent(image: U8, k1: float) -> U8:
    """What a lens of one coefficient makes of the ideal image."""
    lens = CameraModel(*CAMERA.pinhole, "radtan", (k1, 0.0, 0.0, 0.0))
    v, u = np.mgrid[: lens.height, : lens.width]
    ideal = lens.undistort_pixels(np.stack((u, v), axis=-1).reshape(-1, 2).astype(np.float64))
    map_uv = ideal.astype(np.float32).reshape(lens.height, lens.width, 2)
    return np.asarray(cv2.remap(image, map_uv, None, cv2.INTER_CUBIC), np.uint8)


def write_posters(
    folder: Path,
    n: int = 8,
    *,
    seed: int = 0,
    with_poses: bool = False,
    with_depth: bool = False,
    order: list[int] | None = None,
    k1: float = 0.0,
) -> Path:
    """Write the walk as a sequence folder; `order` shuffles its images.

    `k1` bends the images by a lens of which the calibration does not know.
    """
    hung, T_world_cam = posters(seed), path(n, seed)

    def view(k: int) -> KnownView:
        image, depth_m = picture(hung, T_world_cam[k])
        shown = bent(image, k1) if k1 else image
        return KnownView(shown, T_world_cam[k], depth_m if with_depth else None)

    views = map(view, order or range(n))
    return write_drive(folder, CAMERA, views, first_s=10.0, with_poses=with_poses)
