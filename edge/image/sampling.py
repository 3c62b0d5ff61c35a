# SPDX-License-Identifier: Apache-2.0
"""Bilinear sampling of level images inside kernels."""

import numpy as np

from edge.kernel import inline_kernel
from edge.types import F32

ONE = np.float32(1.0)


@inline_kernel
def sample(
    flat: F32, at: np.int32, row: np.int32, fu: np.float32, fv: np.float32
) -> tuple[np.float32, np.float32, np.float32]:
    """Grey and gradient between four pixels of a flattened (h, w, 3) level image.

    at      index of the upper left pixel's grey;  row  elements of an image row
    fu, fv  offsets from that pixel [px], 0 to 1
    """
    w11 = fu * fv
    w01 = fu - w11
    w10 = fv - w11
    w00 = ONE - fu - fv + w11
    below = at + row
    grey = w00 * flat[at] + w01 * flat[at + 3] + w10 * flat[below] + w11 * flat[below + 3]
    gx = w00 * flat[at + 1] + w01 * flat[at + 4] + w10 * flat[below + 1] + w11 * flat[below + 4]
    gy = w00 * flat[at + 2] + w01 * flat[at + 5] + w10 * flat[below + 2] + w11 * flat[below + 5]
    return grey, gx, gy
