# SPDX-License-Identifier: Apache-2.0
"""Which detection lies over which pixel."""

import numpy as np

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
    place = np.rint(np.nan_to_num(pixels, nan=-1e6, posinf=-1e6, neginf=-1e6)).astype(np.int64)
    column, row = place[:, 0] - mask.left, place[:, 1] - mask.top
    held: Bools = (column >= 0) & (column < w) & (row >= 0) & (row < h)
    at = np.flatnonzero(held)
    held[at] = mask.inside[row[at], column[at]]
    return held
