# SPDX-License-Identifier: Apache-2.0
"""The unexposed frame of an image: beyond a fisheye's circle, around an undistorted picture.

Its edge stands still in the image while everything else moves; whoever measures motion by it is
pulled towards standing still.
"""

import cv2
import numpy as np

from edge.types import F32, U8

# What no light fell on, as compression leaves it [grey].
_DARK_GREY = 12
# A frame is wider than this [px] and takes such a share of the image; more is a dark scene.
_MIN_WIDTH_PX = 5
_MIN_SHARE, _MAX_SHARE = 0.003, 0.8
# How densely the image's sides are asked first, whether there can be a frame at all.
_STEP_PX = 4


def exposed(grey: U8 | F32) -> U8 | None:
    """Where light fell: (h, w) uint8, 1 but for dark pixels joined to the image's sides.

    grey  (h, w)  uint8 or float32

    None where there is no such frame, which is most often the case.
    """
    if not _may_have_frame(grey):
        return None
    dark = (grey <= _DARK_GREY).astype(np.uint8)
    # One row and column more on each side joins all that touches a side.
    wide = np.pad(dark, _MIN_WIDTH_PX, constant_values=1)
    wide = cv2.morphologyEx(wide, cv2.MORPH_OPEN, np.ones((_MIN_WIDTH_PX, _MIN_WIDTH_PX), np.uint8))
    _, labels = cv2.connectedComponents(wide, connectivity=4)
    inner = slice(_MIN_WIDTH_PX, -_MIN_WIDTH_PX)
    frame = labels[inner, inner] == labels[0, 0]
    if not _MIN_SHARE <= float(frame.mean()) <= _MAX_SHARE:
        return None
    return np.asarray(~frame, np.uint8)


def _may_have_frame(grey: U8 | F32) -> bool:
    """Whether enough of the outermost pixels are dark."""
    sides = (grey[0, ::_STEP_PX], grey[-1, ::_STEP_PX], grey[::_STEP_PX, 0], grey[::_STEP_PX, -1])
    dark = sum(int(np.count_nonzero(side <= _DARK_GREY)) for side in sides)
    return dark * _STEP_PX >= 4 * _MIN_WIDTH_PX


def eroded(mask: U8, margin: int) -> U8:
    """Keep pixels whose square neighbourhood of `margin` px is inside the image and valid."""
    square = np.ones((2 * margin + 1, 2 * margin + 1), np.uint8)
    kept = cv2.erode(mask, square, borderType=cv2.BORDER_CONSTANT, borderValue=0.0)
    return np.asarray(kept, np.uint8)
