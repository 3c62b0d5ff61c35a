# SPDX-License-Identifier: Apache-2.0
"""Drives the search for lines once, over made-up boards on a wall."""

import cv2
import numpy as np

from edge.config.lines import PairingConfig, SegmentConfig
from edge.geometry.camera import CameraModel
from edge.lines.detector import SegmentDetector
from edge.lines.guided import localise
from edge.lines.line import ends, lines_between
from edge.types import F64

_DISTANCE_M = 2.0
_SIGMA_M = 0.01


def warm_lines(camera: CameraModel) -> bool:
    """Compile or load what finds segments and tells poses from lines; whether it told one."""
    image = np.full((camera.height, camera.width), 60, np.uint8)
    width, height = camera.width // 8, camera.height // 8
    for column in range(1, 7, 2):
        for row in range(1, 7, 2):
            corner = np.array([column * width, row * height])
            board = np.array([[0, 0], [width, 3], [width + 5, height], [4, height - 2]])
            cv2.fillPoly(image, [(corner + board).astype(np.int32)], 200)
    valid = np.full_like(image, 1)
    detector = SegmentDetector(SegmentConfig())
    detector.detect(image, valid)  # as where a lens was taken out
    image.flags.writeable = False  # as cameras give them: to Numba that is another type
    segments = detector.detect(image)
    first, last = (_on_wall(pixels, camera) for pixels in np.split(ends(segments), 2, axis=1))
    half = 0.5 * np.linalg.norm(last - first, axis=1)
    span = np.stack((-half, half), axis=1)
    lines = lines_between(first, last, _SIGMA_M)
    T = np.eye(4)
    T[0, 3] = _SIGMA_M
    found = localise(lines, span, segments, camera.pinhole, T, PairingConfig())
    return found is not None


def _on_wall(pixels: F64, camera: CameraModel) -> F64:
    rays = np.column_stack((camera.normalise(pixels), np.ones(len(pixels))))
    return np.asarray(_DISTANCE_M * rays, np.float64)
