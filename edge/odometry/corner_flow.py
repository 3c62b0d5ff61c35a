# SPDX-License-Identifier: Apache-2.0
"""Corners followed from one image to the next."""

import cv2
import numpy as np

from edge.types import F32, F64, U8, Bools

# Corners whose way back misses their origin by more are dropped [px].
MAX_ROUND_TRIP_PX = 0.7
# Evening out: neighbourhood, grey levels of one local deviation, deviation taken for noise.
FLATTEN_PX, FLAT_GAIN, FLAT_NOISE = 21, 40.0, 6.0


def flatten(grey: U8) -> U8:
    """Image with local mean and contrast evened out, so that exposure changes move no corner."""
    image = grey.astype(np.float32)
    image -= cv2.boxFilter(image, -1, (FLATTEN_PX, FLATTEN_PX))
    squares = cv2.boxFilter(image * image, -1, (FLATTEN_PX, FLATTEN_PX))
    spread = np.sqrt(np.maximum(squares, 0.0))
    return np.asarray(cv2.convertScaleAbs(FLAT_GAIN * image / (spread + FLAT_NOISE) + 128.0))


def followed(before: U8, after: U8, corners: F32, moved: F32 | F64) -> F32:
    """Where corners (n, 2) of the flattened image `before` are in `after`; NaN once lost.

    moved : (n, 2) that each is expected to go
    """
    out = np.full_like(corners, np.nan)
    alive = np.flatnonzero(np.isfinite(corners[:, 0]))
    if not len(alive):
        return out
    old = np.ascontiguousarray(corners[alive])
    now, found = flow(before, after, old, (old + moved[alive]).astype(np.float32))
    back, returned = flow(after, before, now, old.copy())
    good = found & returned & (np.linalg.norm(back - old, axis=1) < MAX_ROUND_TRIP_PX)
    good &= np.all((now > 2) & (now < np.array(after.shape[::-1]) - 3), axis=1)
    out[alive[good]] = now[good]
    return out


def flow(before: U8, after: U8, pixels: F32, guess: F32) -> tuple[F32, Bools]:
    """Where `pixels` (n, 2) of one image are in another (Lucas-Kanade), and which were found."""
    moved, found, _ = cv2.calcOpticalFlowPyrLK(
        before,
        after,
        pixels,
        guess,
        winSize=(15, 15),
        maxLevel=4,
        criteria=(cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 20, 0.01),
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )
    return np.asarray(moved), np.asarray(found.ravel() > 0)
