# SPDX-License-Identifier: Apache-2.0
"""Images that show little but walls: how plain one is, and the smooth copies it is tracked by.

Values between pixels are means of noisy ones, and so less noisy than these. Where no edge holds a
pose it therefore seems to fit best half a pixel off, whatever the camera did. Smoothed before, all
places are about equally noisy: what half a pixel gains shrinks from 3/4 of the noise's variance to
1/23. Textures would lose more by it than they gain.
"""

from collections.abc import Sequence

import numpy as np

from edge.image import kernels
from edge.types import F32, U8

# Images with more strong gradients than this, as a share of their pixels, have texture enough.
# Rooms of plain walls have 0.02 to 0.06, bare corridors 0.07 to 0.19, kitchens and offices 0.2 and
# more; there, lines made paths half as bad again.
TEXTURED_SHARE, STRONG_GREY = 0.065, 8.0
# With fewer than this they are smoothed wholly, between the two in part.
PLAIN_SHARE = 0.045
# Weights of a 3x3 binomial mean: that of its middle, and the sum of all their squares.
_MIDDLE, _SQUARES = 4.0 / 16.0, (6.0 / 16.0) ** 2


def strong_share(level0: F32, mask: U8) -> float:
    """Share of an image's (h, w, 3) pixels that lie in strong gradients."""
    squared = level0[..., 1] ** 2 + level0[..., 2] ** 2
    return float(np.count_nonzero((squared > STRONG_GREY**2) & (mask > 0)) / mask.size)


def smoothing(level0: F32, mask: U8) -> float:
    """How much of a 3x3 binomial mean an image (h, w, 3) is to be tracked by, 0 to 1."""
    lacking = TEXTURED_SHARE - strong_share(level0, mask)
    return min(max(lacking / (TEXTURED_SHARE - PLAIN_SHARE), 0.0), 1.0)


def noise_left(share: float) -> float:
    """What smoothing by `share` leaves of the variance of noise that differs by pixel."""
    kept = 1.0 - share
    return kept**2 + 2.0 * kept * share * _MIDDLE + share**2 * _SQUARES


class Smoother:
    """Makes smooth copies of images, in memory of its own. Owned by one thread."""

    def __init__(self) -> None:
        self._copy: F32 = np.empty((0, 0, 3), np.float32)
        self._rows: F32 = np.empty((3, 0), np.float32)

    def smoothed(self, levels: Sequence[F32], share: float) -> Sequence[F32]:
        """Levels (h, w, 3) of which the finest is moved by `share` to its 3x3 binomial mean.

        Until the next call. Coarser levels are means already, and only lead to the finest.
        """
        if share == 0.0:
            return levels
        if self._copy.shape != levels[0].shape:
            self._copy = np.empty_like(levels[0])
            self._rows = np.empty((3, levels[0].shape[1]), np.float32)
        np.copyto(self._copy, levels[0])
        kernels.smooth(self._copy, np.float32(share), self._rows)
        kernels.differentiate(self._copy)
        return (self._copy, *levels[1:])
