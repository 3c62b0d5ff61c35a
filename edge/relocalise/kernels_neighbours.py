# SPDX-License-Identifier: Apache-2.0
"""Nearest samples of pixels."""

import numpy as np
from numpy.typing import NDArray

from edge.kernel import kernel
from edge.types import F32, F64


@kernel
def nearest_samples(
    pixels: F64,
    samples: F32,
    order: NDArray[np.int64],
    rows: F64,
    radius_px: float,
    nearest: NDArray[np.int64],
) -> None:
    """Nearest sample to each pixel within a radius; of two equally near the first.

    pixels   (n, 2)  float64
    samples  (m, 2)  float32
    order    (m,)    int64    of the samples by their v
    rows     (m,)    float64  v in that order
    nearest  (n,)    int64, out  -1 where none is near
    """
    for i in range(pixels.shape[0]):
        u, v = pixels[i, 0], pixels[i, 1]
        best, found = radius_px * radius_px, -1
        for k in range(np.searchsorted(rows, v - radius_px), len(rows)):
            if rows[k] > v + radius_px:
                break
            j = order[k]
            du, dv = u - samples[j, 0], v - samples[j, 1]
            square = du * du + dv * dv
            if square < best or (square == best and (found < 0 or j < found)):
                best, found = square, j
        nearest[i] = found
