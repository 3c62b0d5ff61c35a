# SPDX-License-Identifier: Apache-2.0
"""Pictures of a printed board as a camera with a real lens takes them: rendered ray by ray."""

import functools

import cv2
import numpy as np

from edge.geometry import se3
from edge.geometry.calibration import View
from edge.geometry.camera import CameraModel
from edge.runtime.board import Board, BoardSpec
from edge.types import F64, U8, Mat4

SPEC = BoardSpec(9, 6, 0.03, 0.0225)
_OVERSAMPLED = 2


def board_poses(count: int, seed: int, reach: float = 0.45) -> list[Mat4]:
    """The board here and there before the camera, tilted to all sides."""
    rng = np.random.default_rng(seed)
    found = []
    for _ in range(count):
        tilt = se3.exp([0, 0, 0, *rng.uniform(-0.6, 0.6, 2), rng.uniform(-0.5, 0.5)])
        centre, place = np.eye(4), np.eye(4)
        centre[:3, 3] = [-0.135, -0.09, 0.0]
        z = rng.uniform(0.18, 0.34)
        place[:3, 3] = [*(rng.uniform(-reach, reach, 2) * z), z]
        found.append(place @ tilt @ centre)
    return found


def exact_views(
    camera: CameraModel, poses: list[Mat4], noise_px: float = 0.0, seed: int = 0
) -> list[View]:
    """Corners where they are, without an image."""
    rng = np.random.default_rng(seed)
    corners = Board(SPEC).corners
    made = []
    for T in poses:
        pixels = camera.project(corners @ T[:3, :3].T + T[:3, 3])
        with np.errstate(invalid="ignore"):
            seen = np.all((pixels > 3) & (pixels < (camera.width - 4, camera.height - 4)), axis=1)
        noise = rng.normal(0.0, noise_px, pixels.shape)
        if seen.sum() >= 12:
            made.append(View(corners[seen], (pixels + noise)[seen]))
    return made


def render(camera: CameraModel, T_cam_board: Mat4, seed: int = 0) -> U8:
    """Grey image of the board before a grey wall, with a little noise."""
    picture = cv2.GaussianBlur(Board(SPEC).draw(), (0, 0), 2.0)
    per_m = picture.shape[1] / ((SPEC.columns + 2) * SPEC.square_m)
    on_board = _meet_plane(_rays(camera), T_cam_board)
    x, y = ((on_board + SPEC.square_m) * per_m - 0.5).astype(np.float32).T
    shape = (_OVERSAMPLED * camera.height, _OVERSAMPLED * camera.width)
    fine = cv2.remap(
        picture,
        x.reshape(shape),
        y.reshape(shape),
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=120,
    )
    image = cv2.resize(fine, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    noise = np.random.default_rng(seed).normal(0.0, 2.0, image.shape)
    grey: U8 = np.clip(0.8 * image + 20 + noise, 0, 255).astype(np.uint8)
    return grey


@functools.cache
def _rays(camera: CameraModel) -> F64:
    """Ideal points (n, 2) on the normalised plane of all sub-pixels."""
    u, v = np.meshgrid(
        (np.arange(_OVERSAMPLED * camera.width) + 0.5) / _OVERSAMPLED - 0.5,
        (np.arange(_OVERSAMPLED * camera.height) + 0.5) / _OVERSAMPLED - 0.5,
    )
    return camera.normalise(camera.undistort_pixels(np.stack((u.ravel(), v.ravel()), axis=1)))


def _meet_plane(ideal: F64, T_cam_board: Mat4) -> F64:
    """Where rays (n, 2) meet the board's plane, in its frame (n, 2) [m]; far off where never."""
    R, t = T_cam_board[:3, :3], T_cam_board[:3, 3]
    rays = np.column_stack((ideal, np.ones(len(ideal)))) @ R
    with np.errstate(all="ignore"):
        depth = (R.T @ t)[2] / rays[:, 2]
        points = rays[:, :2] * depth[:, None] - (R.T @ t)[:2]
    points[~(depth > 0.0) | ~np.isfinite(points).all(axis=1)] = 1e3
    return np.clip(points, -1e3, 1e3)
