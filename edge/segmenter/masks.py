# SPDX-License-Identifier: Apache-2.0
"""Masks of single objects, made inside their boxes only."""

import math

import cv2
import numpy as np

from edge.segmenter.letterbox import Letterbox, image_from_input
from edge.types import F32, Mask


def sample_plane(plane: F32, box: F32, letterbox: Letterbox, threshold: float) -> Mask | None:
    """Pixels of the image inside `box` where a plane over the whole input is above `threshold`.

    plane  (h, w)  float32  one value for each of h x w equal parts of the model's input
    box    (4,)    float32  of the object in the image [px]

    None where no pixel is.
    """
    scale, shift = image_from_input(letterbox)
    parts = np.array([plane.shape[1], plane.shape[0]], dtype=np.float64)
    parts /= (letterbox.input_width, letterbox.input_height)
    # Image pixel to plane: to the input's edges, to the plane's, then to its centres.
    slope = parts / scale
    left, top, right, bottom = _pixels_in(box, letterbox.image_width, letterbox.image_height)
    if right <= left or bottom <= top:
        return None
    origin = slope * (left, top) - shift * slope - 0.5
    to_plane = np.array([[slope[0], 0.0, origin[0]], [0.0, slope[1], origin[1]]])
    values = cv2.warpAffine(
        plane,
        to_plane,
        (right - left, bottom - top),
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_REPLICATE,
    )
    inside = values > threshold
    if not inside.any():
        return None
    inside.flags.writeable = False
    return Mask(left, top, inside)


def _pixels_in(box: F32, width: int, height: int) -> tuple[int, int, int, int]:
    """Columns and rows whose centres a box covers, half-open: left, top, right, bottom."""
    left, top = (max(0, math.ceil(v - 1e-3)) for v in box[:2])
    right = min(width, math.floor(box[2] + 1e-3) + 1)
    bottom = min(height, math.floor(box[3] + 1e-3) + 1)
    return left, top, right, bottom
