# SPDX-License-Identifier: Apache-2.0
"""Random lines before a camera, with exact truth."""

import numpy as np

from edge.geometry import se3, so3
from edge.lines.line import Lines, Segments, lines_between, segments_between
from edge.types import F64, Mat4, Pinhole

CAMERA = Pinhole(640, 480, 500.0, 500.0, 319.5, 239.5)
_MIN_LENGTH_PX = 30.0


def project(points: F64) -> F64:
    """Pixels (..., 2) of points (..., 3) in the camera's frame."""
    focal, centre = np.array(CAMERA[2:4]), np.array(CAMERA[4:])
    return focal * points[..., :2] / points[..., 2:] + centre


def viewpoint(rng: np.random.Generator) -> Mat4:
    """T_cam_lines of a camera some three metres off, turned by about 35 degrees."""
    turn = np.r_[rng.normal(0.0, 0.2, 3), rng.normal(0.0, 0.6, 3)]
    return se3.exp([0, 0, 3.0, 0, 0, 0]) @ se3.exp(turn)


def ends_before(rng: np.random.Generator, T_cam_lines: Mat4, n: int, *, flat: bool) -> F64:
    """Ends (n, 2, 3) of segments that are wholly in the image; in the plane z = 0 if `flat`."""
    found: list[F64] = []
    size = np.array([1.0, 0.8, 0.0 if flat else 1.0])
    while len(found) < n:
        start = rng.uniform(-size, size)
        step = rng.normal(size=3) * (size > 0.0)
        pair = start + np.outer([0.0, rng.uniform(0.3, 1.2) / np.linalg.norm(step)], step)
        local = se3.transform(T_cam_lines, pair)
        if local[:, 2].min() < 0.5:
            continue
        pixels = project(local)
        inside = np.all(pixels > 0.0) and np.all(pixels < [640.0, 480.0])
        if inside and np.linalg.norm(pixels[1] - pixels[0]) > _MIN_LENGTH_PX:
            found.append(pair)
    return np.array(found)


def observed(
    rng: np.random.Generator, T_cam_lines: Mat4, ends: F64, noise_px: float, noise_m: float
) -> tuple[Lines, Segments]:
    """What the map and the image say of these ends (n, 2, 3), each with its noise."""
    pixels = project(se3.transform(T_cam_lines, ends.reshape(-1, 3))).reshape(-1, 4)
    segments = segments_between(pixels + rng.normal(0.0, noise_px, pixels.shape), noise_px)
    known = ends + rng.normal(0.0, noise_m, ends.shape)
    return lines_between(known[:, 0], known[:, 1], noise_m), segments


def turned(rng: np.random.Generator, T_cam_lines: Mat4, angle_rad: float) -> Mat4:
    """The pose with the lines turned by an angle about a random axis through their middle."""
    axis = rng.normal(size=3)
    R = so3.exp(angle_rad * axis / np.linalg.norm(axis))
    return se3.from_rotation_translation(R @ T_cam_lines[:3, :3], T_cam_lines[:3, 3])
