# SPDX-License-Identifier: Apache-2.0
"""Space in cubes, each named by one number."""

import numpy as np
from numpy.typing import NDArray

from edge.types import F64

Keys = NDArray[np.int64]

_BITS = 20  # of a coordinate: fifty kilometres of cubes of five centimetres
_HALF = 1 << (_BITS - 1)


def cell_keys(xyz: F64, cell_m: float) -> Keys:
    """The cube (n,) that each place (n, 3) lies in."""
    at = np.floor(xyz / cell_m).astype(np.int64) + _HALF
    keys: Keys = (at[:, 0] << 2 * _BITS) | (at[:, 1] << _BITS) | at[:, 2]
    return keys


def cell_means(keys: Keys, xyz: F64) -> tuple[Keys, F64]:
    """Each cube once, in order, and the mean (n, 3) of the places in it."""
    cells, owner, count = np.unique(keys, return_inverse=True, return_counts=True)
    sums = np.stack([np.bincount(owner, xyz[:, axis], len(cells)) for axis in range(3)], axis=1)
    return cells, sums / count[:, None]
