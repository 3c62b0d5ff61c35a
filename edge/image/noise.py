# SPDX-License-Identifier: Apache-2.0
"""How noisy an image is, and how much of that to smooth away."""

import numpy as np

from edge.image import kernels
from edge.types import I32, U8

# Every so many pixels of every so many rows tell: some 5000 of 640x480.
STEP = 8
# The smoothest of them show noise alone, the others edges and texture too. A normal deviate is
# below MARGIN times its sigma in SMOOTHEST of all cases; the mask makes six sigma of one.
SMOOTHEST, MARGIN, GAIN = 0.3, 0.3853, 6.0
N_COUNTS = 256
# Noise that point selection and outlier limits stand, and where smoothing is whole [grey].
BEARABLE_GREY, UNBEARABLE_GREY = 3.0, 5.0


class NoiseMeter:
    """Owned by one thread."""

    def __init__(self) -> None:
        self._counts: I32 = np.zeros(N_COUNTS, np.int32)

    def sigma_grey(self, image: U8) -> float:
        """Standard deviation of the noise of `image` (H, W) uint8 [grey]; 0 where nothing tells."""
        kernels.count_roughness(image, STEP, self._counts)
        total = np.cumsum(self._counts)
        wanted = SMOOTHEST * float(total[-1])
        above = int(np.searchsorted(total, wanted))
        if total[-1] == 0 or above == 0:
            return 0.0
        # Counts are of whole numbers: those of n lie between n - 1/2 and n + 1/2.
        share = (wanted - float(total[above - 1])) / float(self._counts[above])
        return (above - 0.5 + share) / (MARGIN * GAIN)


def smoothing(sigma_grey: float) -> float:
    """How much of a 3x3 binomial mean an image with this noise needs, 0 to 1."""
    share = (sigma_grey - BEARABLE_GREY) / (UNBEARABLE_GREY - BEARABLE_GREY)
    return min(max(share, 0.0), 1.0)
