# SPDX-License-Identifier: Apache-2.0
"""Matches of a made-up room with exactly the errors that the solver is told of."""

from typing import NamedTuple

import numpy as np

from edge.geometry import se3, so3
from edge.geometry.camera import CameraModel
from edge.relocalise.correspondences import Correspondences
from edge.types import Mat4

LENS = CameraModel(640, 480, 525.0, 525.0, 319.5, 239.5)
CAMERA = LENS.pinhole


class RoomMatches(NamedTuple):
    T_map_cam: Mat4
    matches: Correspondences
    wrong: np.ndarray  # (n,) bool


def room_matches(
    seed: int,
    n: int = 200,
    wrong_share: float = 0.0,
    sigma_px: float = 0.8,
    sigma_along_m: float = 0.0,
    window_px: tuple[float, float, float, float] = (20.0, 20.0, 620.0, 460.0),
) -> RoomMatches:
    """n points 1 to 4 m away; the map saw them from 0.7 m aside, askew, wrong along those rays."""
    rng = np.random.default_rng(seed)
    T = se3.exp(rng.normal(0.0, 1.0, 6))
    u0, v0, u1, v1 = window_px
    pixels = rng.uniform((u0, v0), (u1, v1), (n, 2))
    depth = rng.uniform(1.0, 4.0, n)
    in_cam = np.column_stack((_rays(pixels) * depth[:, None], depth))
    true = se3.transform(T, in_cam)
    ray = true - (T[:3, 3] + 0.5 * T[:3, 0] + 0.5 * T[:3, 1])
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    axis = np.maximum(sigma_along_m, 1e-4) * ray
    covariance = axis[:, :, None] * axis[:, None, :] + 1e-8 * np.eye(3)
    noisy = true + rng.normal(size=(n, 1)) * axis + 1e-4 * rng.normal(size=(n, 3))
    seen = pixels + sigma_px * rng.normal(size=(n, 2))
    wrong = rng.random(n) < wrong_share
    seen[wrong] = rng.uniform((0, 0), (640, 480), (int(wrong.sum()), 2))
    matches = Correspondences(
        seen,
        noisy,
        np.ascontiguousarray(covariance[:, (0, 0, 0, 1, 1, 2), (0, 1, 2, 1, 2, 2)]),
        np.full(n, sigma_px**2),
        axis,
        np.zeros((n, 2, 2)),
    )
    return RoomMatches(T, matches, wrong)


def error(T_map_cam: Mat4, T_true: Mat4) -> np.ndarray:
    """Position and rotation (6,) in map axes that lead to the truth."""
    w = so3.log(T_true[:3, :3] @ T_map_cam[:3, :3].T)
    return np.concatenate((T_true[:3, 3] - T_map_cam[:3, 3], w))


def _rays(pixels: np.ndarray) -> np.ndarray:
    return (pixels - (CAMERA.cx, CAMERA.cy)) / (CAMERA.fx, CAMERA.fy)
