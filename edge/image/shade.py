# SPDX-License-Identifier: Apache-2.0
"""Images freed of soft shades: lamps that the camera carries, its own shadow, dark corners.

Such a shade stands still in the image or moves by itself, and so does not move with the scene. Who
compares brightness is drawn along by it: under a spotlight poses were up to 15 cm wrong.
"""

import cv2
import numpy as np

from edge.types import F32, F64, U8

# A shade is what is left of an image after a mean over so many pixels (sigma). Less takes the
# texture away by which motion is measured, more leaves more of the shade.
SIGMA_PX = 24.0
_CELL_PX = 8
# Where it is dark, noise and compression are not to become texture [grey].
_FLOOR_GREY = 20.0
_LEAST_SHARE = 1e-3  # of a mean's weight that lies inside the image


def gain_against_shade(grey: F32, mask: U8) -> F32 | None:
    """Factors (h, w) that make all parts of an image about as bright as the whole of it is.

    grey, mask  as of `gain_by_cells`

    None where nothing shows.
    """
    cells = gain_by_cells(grey, mask)
    if cells is None:
        return None
    height, width = grey.shape
    size = cells.shape[1] * _CELL_PX, cells.shape[0] * _CELL_PX
    gain = cv2.resize(cells, size, interpolation=cv2.INTER_LINEAR)[:height, :width]
    beyond = ((0, height - gain.shape[0]), (0, width - gain.shape[1]))
    return np.ascontiguousarray(np.pad(gain, beyond, mode="edge"))


def gain_by_cells(grey: F32, mask: U8) -> F32 | None:
    """Those factors by cells of 8x8 pixels, (h // 8, w // 8); for `sampled_gain`.

    grey  (h, w)  float32
    mask  (h, w)  uint8    1 where it shows something

    None where nothing shows.
    """
    # Whole cells alone: means over parts of pixels take ten times as long.
    rows, columns = (max(1, n // _CELL_PX) for n in grey.shape)
    whole = slice(rows * _CELL_PX), slice(columns * _CELL_PX)
    shown = mask[whole].astype(np.float32)
    share = cv2.resize(shown, (columns, rows), interpolation=cv2.INTER_AREA)
    light = cv2.resize(grey[whole] * shown, (columns, rows), interpolation=cv2.INTER_AREA)
    total = float(share.sum())
    if not total > 0.0:
        return None
    mean = float(light.sum()) / total
    near_share, near_light = (_spread(part) for part in (share, light))
    known = near_share > _LEAST_SHARE
    around = np.full_like(light, mean)
    np.divide(near_light, near_share, out=around, where=known)
    return np.asarray((mean + _FLOOR_GREY) / (around + _FLOOR_GREY), np.float32)


def sampled_gain(cells: F32, u: F32, v: F32) -> F64:
    """The factors at pixels (n,), by cells as of `gain_by_cells`."""
    row, column = ((at - 0.5 * (_CELL_PX - 1)) / _CELL_PX for at in (v, u))
    return bilinear(
        cells, np.clip(column, 0.0, cells.shape[1] - 1), np.clip(row, 0.0, cells.shape[0] - 1)
    )


def bilinear(image: F32, u: F32, v: F32) -> F64:
    """Samples of an image (h, w) at pixels (..., n) from 0 to w - 1, h - 1."""
    height, width = image.shape
    x, y = np.floor(u).astype(np.int64), np.floor(v).astype(np.int64)
    right, below = np.minimum(x + 1, width - 1), np.minimum(y + 1, height - 1)
    a, b = u - x, v - y
    top = (1.0 - a) * image[y, x] + a * image[y, right]
    low = (1.0 - a) * image[below, x] + a * image[below, right]
    return np.asarray((1.0 - b) * top + b * low)


def _spread(cells: F32) -> F32:
    sigma = SIGMA_PX / _CELL_PX
    blurred = cv2.GaussianBlur(cells, (0, 0), sigma, borderType=cv2.BORDER_CONSTANT)
    return np.asarray(blurred, np.float32)
