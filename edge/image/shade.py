# SPDX-License-Identifier: Apache-2.0
"""Images freed of soft shades: lamps that the camera carries, its own shadow, dark corners.

Such a shade stands still in the image or moves by itself, and so does not move with the scene. Who
compares brightness is drawn along by it: under a spotlight poses were up to 15 cm wrong.
"""

import cv2
import numpy as np

from edge.types import F32, U8

# A shade is what is left of an image after a mean over so many pixels (sigma). Less takes the
# texture away by which motion is measured, more leaves more of the shade.
SIGMA_PX = 24.0
_CELL_PX = 8
# Where it is dark, noise and compression are not to become texture [grey].
_FLOOR_GREY = 20.0
_LEAST_SHARE = 1e-3  # of a mean's weight that lies inside the image


def gain_against_shade(grey: F32, mask: U8) -> F32 | None:
    """Factors (h, w) that make all parts of an image about as bright as the whole of it is.

    grey  (h, w)  float32
    mask  (h, w)  uint8    1 where it shows something

    None where nothing shows.
    """
    height, width = grey.shape
    size = max(1, width // _CELL_PX), max(1, height // _CELL_PX)
    shown = mask.astype(np.float32)
    share = cv2.resize(shown, size, interpolation=cv2.INTER_AREA)
    light = cv2.resize(grey * shown, size, interpolation=cv2.INTER_AREA)
    total = float(share.sum())
    if not total > 0.0:
        return None
    mean = float(light.sum()) / total
    near_share, near_light = (_spread(part) for part in (share, light))
    known = near_share > _LEAST_SHARE
    around = np.full_like(light, mean)
    np.divide(near_light, near_share, out=around, where=known)
    gain = ((mean + _FLOOR_GREY) / (around + _FLOOR_GREY)).astype(np.float32)
    return np.asarray(cv2.resize(gain, (width, height), interpolation=cv2.INTER_LINEAR), np.float32)


def _spread(cells: F32) -> F32:
    sigma = SIGMA_PX / _CELL_PX
    blurred = cv2.GaussianBlur(cells, (0, 0), sigma, borderType=cv2.BORDER_CONSTANT)
    return np.asarray(blurred, np.float32)
