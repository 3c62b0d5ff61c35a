# SPDX-License-Identifier: Apache-2.0
"""Which detection lies over which pixel."""

import numpy as np

from edge.types import F32, I32, Detections


def find_cover(detections: Detections, pixels: F32) -> I32:
    """Number of the best detection whose mask holds each pixel (n, 2) of the image; -1 for none."""
    owner: I32 = np.full(len(pixels), -1, dtype=np.int32)
    nearest = np.rint(pixels).astype(np.int64)
    for i in reversed(range(len(detections.masks))):  # the best last, over the others
        mask = detections.masks[i]
        column, row = nearest[:, 0] - mask.left, nearest[:, 1] - mask.top
        h, w = mask.inside.shape
        at = np.flatnonzero((column >= 0) & (column < w) & (row >= 0) & (row < h))
        owner[at[mask.inside[row[at], column[at]]]] = i
    return owner
