# SPDX-License-Identifier: Apache-2.0
"""Which detection lies over which pixel."""

import cv2
import numpy as np

from edge.geometry.camera import CameraModel
from edge.types import F32, F64, I32, Bools, Detections, Mask


def find_cover(detections: Detections, pixels: F32) -> I32:
    """Number of the best detection whose mask holds each pixel (n, 2) of the image; -1 for none."""
    owner: I32 = np.full(len(pixels), -1, dtype=np.int32)
    for i in reversed(range(len(detections.masks))):  # the best last, over the others
        owner[holds(detections.masks[i], pixels)] = i
    return owner


def holds(mask: Mask, pixels: F32 | F64) -> Bools:
    """Which pixels (n, 2) the mask holds (n,); none that is not finite."""
    h, w = mask.inside.shape
    # Half a pixel more, for the border rounds to even; a comparison with NaN is false.
    u, v = pixels[:, 0], pixels[:, 1]
    held: Bools = (u >= mask.left - 0.5) & (u <= mask.left + w - 0.5)
    held &= (v >= mask.top - 0.5) & (v <= mask.top + h - 0.5)
    at = np.flatnonzero(held)
    place = np.rint(pixels[at]).astype(np.int64) - (mask.left, mask.top)
    inside = ((place >= 0) & (place < (w, h))).all(axis=1)
    held[at] = inside
    held[at[inside]] = mask.inside[place[inside, 1], place[inside, 0]]
    return held


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
    filled = np.zeros((h, w), np.uint8)
    cv2.fillConvexPoly(filled, cv2.convexHull(inside - (left, top)), 1)
    return Mask(int(left), int(top), filled.astype(bool))
