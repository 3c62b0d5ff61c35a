# SPDX-License-Identifier: Apache-2.0
"""Where an image can show nothing: blown out by light, or lost in the dark."""

import cv2
import numpy as np

from edge.geometry.camera import CameraModel
from edge.types import F64, U8, Bools

# What a sensor gives where it has had too much or next to no light [grey].
_BRIGHTEST, _DARKEST = 250, 3
_IS_CLIPPED = np.array([not _DARKEST < grey < _BRIGHTEST for grey in range(256)], np.uint8)
# Where so much of a patch is clipped, its corner is not found, or looks like another.
_CLIPPED_SHARE = 0.4
_PATCH_PX = 31
_MIN_SHARE = 0.02  # of an image; less changes nothing


def clipped(image: U8) -> U8 | None:
    """Where patches are clipped: (h, w) uint8, 0 or 1; None where hardly any of the image is.

    image  (h, w)  uint8
    """
    lost = cv2.LUT(image, _IS_CLIPPED)
    if cv2.countNonZero(lost) < _MIN_SHARE * image.size:
        return None
    share = cv2.boxFilter(lost, cv2.CV_32F, (_PATCH_PX, _PATCH_PX))
    return np.asarray(share > _CLIPPED_SHARE, np.uint8)


def can_show(mask: U8 | None, pixels: F64, camera: CameraModel) -> Bools:
    """Which ideal pixels (n, 2) of `camera` lie where an image with that mask shows something."""
    if mask is None:
        return np.ones(len(pixels), np.bool_)
    height, width = mask.shape
    at = np.nan_to_num(np.rint(camera.distort_pixels(pixels)), nan=0.0)
    u, v = np.clip(at, 0, (width - 1, height - 1)).astype(np.int64).T
    return np.asarray(mask[v, u] == 0)
