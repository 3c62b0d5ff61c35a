# SPDX-License-Identifier: Apache-2.0
"""Which detection lies over which pixel."""

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from edge.geometry.camera import CameraModel
from edge.types import F32, F64, I32, Bools, Detections, Mask

_LEAST_SOLIDITY = 0.5  # area of a mask, as a share of its convex hull's


def find_cover(detections: Detections, pixels: F32) -> I32:
    """Number of the best detection whose mask holds each pixel (n, 2) of the image; -1 for none."""
    owner: I32 = np.full(len(pixels), -1, dtype=np.int32)
    if len(pixels) == 0:
        return owner
    low, high = np.fmin.reduce(pixels).tolist(), np.fmax.reduce(pixels).tolist()
    for i in reversed(range(len(detections.masks))):  # the best last, over the others
        if reaches(detections.masks[i], low, high):
            owner[holds(detections.masks[i], pixels)] = i
    return owner


def reaches(mask: Mask, low: Sequence[float] | F32, high: Sequence[float] | F32) -> bool:
    """Whether a mask has pixels in or beside the box from `low` to `high` (2,); not beyond NaN."""
    h, w = mask.inside.shape
    return bool(
        mask.left - 1 <= high[0]
        and low[0] <= mask.left + w
        and mask.top - 1 <= high[1]
        and low[1] <= mask.top + h
    )


def holds(mask: Mask, pixels: F32 | F64) -> Bools:
    """Which pixels (n, 2) the mask holds (n,); none that is not finite."""
    h, w = mask.inside.shape
    # Half a pixel more, for the border rounds to even.
    low = np.array([mask.left, mask.top]) - 0.5
    held = between(pixels, low, low + np.array([w, h]))
    at = np.flatnonzero(held)
    if len(at):
        place = np.rint(pixels[at]).astype(np.int64)
        column, row = place[:, 0] - mask.left, place[:, 1] - mask.top
        inside = (column >= 0) & (column < w) & (row >= 0) & (row < h)
        held[at] = inside
        held[at[inside]] = mask.inside[row[inside], column[inside]]
    return held


def find_held(masks: Sequence[Mask], pixels: F32) -> Bools:
    """Which pixels (n, 2) any of the masks holds (n,)."""
    held: Bools = np.zeros(len(pixels), bool)
    for mask in masks:
        held |= holds(mask, pixels)
    return held


def between(pixels: F32 | F64 | NDArray[np.int64], low: ArrayLike, high: ArrayLike) -> Bools:
    """Which pixels (n, 2) lie in a box, its border included; none that is not a number."""
    # Column by column: a reduction over two columns takes five times as long.
    (left, top), (right, bottom) = np.asarray(low), np.asarray(high)
    u, v = pixels[:, 0], pixels[:, 1]
    inside: Bools = (u >= left) & (u <= right) & (v >= top) & (v <= bottom)
    return inside


def grown(mask: Mask, by_px: int) -> Mask:
    """The mask and some pixels around it."""
    size = np.ones((2 * by_px + 1, 2 * by_px + 1), np.uint8)
    inside = np.pad(mask.inside.astype(np.uint8), by_px)
    grown = cv2.dilate(inside, size).astype(bool)
    return Mask(mask.left - by_px, mask.top - by_px, grown)


def mask_of(pixels: F32, camera: CameraModel) -> Mask | None:
    """The outline (a convex hull, filled) of points of an image as a mask."""
    inside = np.clip(np.rint(pixels), 0, (camera.width - 1, camera.height - 1)).astype(np.int32)
    if len(inside) < 3:
        return None
    left, top = inside.min(axis=0)
    w, h = inside.max(axis=0) - (left, top) + 1
    return Mask(int(left), int(top), _hull(inside - (left, top), (int(h), int(w))))


def is_solid(mask: Mask) -> bool:
    """Whether a mask can be of one thing: it fills most of its convex hull.

    Else it is of colours here and there, as of a picture on a wall, and nothing is at its middle.
    """
    inside = mask.inside
    rows = np.flatnonzero(inside.any(axis=1))
    if not len(rows):
        return False
    # The ends of its rows have the same hull as all its pixels.
    first = inside[rows].argmax(axis=1)
    last = inside.shape[1] - 1 - inside[rows, ::-1].argmax(axis=1)
    ends = np.vstack((np.column_stack((first, rows)), np.column_stack((last, rows))))
    hull = _hull(ends.astype(np.int32), inside.shape)
    return bool(np.count_nonzero(inside) >= _LEAST_SOLIDITY * np.count_nonzero(hull))


def _hull(pixels: I32, shape: tuple[int, ...]) -> Bools:
    """The convex hull of pixels (n, 2), filled, in an image of this shape (h, w)."""
    filled = np.zeros(shape, np.uint8)
    cv2.fillConvexPoly(filled, cv2.convexHull(pixels), 1)
    return filled.astype(bool)
