# SPDX-License-Identifier: Apache-2.0
"""Drives what the odometry does in plain rooms once, over made-up boards on a wall."""

import cv2
import numpy as np

from edge.config.odometry import OdometryConfig
from edge.geometry import se3
from edge.geometry.camera import CameraModel
from edge.image.pyramid import half_size
from edge.odometry.keyframe import Keyframe
from edge.odometry.line_start import LineStarter
from edge.odometry.line_window import WindowLines
from edge.types import F32, U8, Frame, Pinhole

_DISTANCE, _STEP_PX = 2.0, 4
_IMAGES = 5


def warm_plain(camera: CameraModel) -> int:
    """Compile or load what starts from edges and keeps lines; how many lines it found."""
    p = half_size(camera.pinhole)
    mask = np.ones((p.height, p.width), np.uint8)
    starter = LineStarter(p, mask, OdometryConfig().resolved())
    lines, keyframes = WindowLines(p, mask, used=True), []
    for k in range(_IMAGES):
        image = _boards(p, k * _STEP_PX)
        frame = Frame(k, k, image)
        starter.step(frame, image)
        T = se3.from_rotation_translation(
            np.eye(3), np.array([k * _STEP_PX * _DISTANCE / p.fx, 0.0, 0.0])
        )
        keyframes.append(Keyframe(frame, k, T, np.zeros(2)))
        lines.look(keyframes[-1], _level(image))
        lines.pack(keyframes)
        n = 8 * len(keyframes)
        lines.add(keyframes, 1e-5, np.zeros((n, n)), np.zeros(n))
        lines.move(np.zeros(n), 1e-5)
        lines.read_back(keyframes, 1.0)
    return len(lines.lines)


def _boards(p: Pinhole, shift_px: int) -> U8:
    image = np.full((p.height, p.width), 60, np.uint8)
    width, height = p.width // 8, p.height // 8
    for column in range(1, 7, 2):
        for row in range(1, 7, 2):
            corner = np.array([column * width + shift_px, row * height])
            board = np.array([[0, 0], [width, 3], [width + 5, height], [4, height - 2]])
            cv2.fillPoly(image, [(corner + board).astype(np.int32)], 200)
    return image


def _level(image: U8) -> F32:
    level = np.zeros((*image.shape, 3), np.float32)
    level[..., 0] = image
    return level
