# SPDX-License-Identifier: Apache-2.0
"""Which parts of an object's space masks of its kind leave bare.

Where a thing like it stands beside or behind an object, a mask over both says little of either from
one place: the other's mask may cover what has gone. From several places it cannot cover all of it,
while what is there is held by masks from everywhere (the visual hull: Laurentini 1994).
"""

import numpy as np
from numpy.typing import NDArray

from edge.types import Bools

_MOST = 100  # images that one viewpoint counts
_KEPT = 300  # viewpoints, those seen from last: what is there now matters, and memory is finite


class Carving:
    """What was seen of the points of one object. Owned by one thread."""

    def __init__(self, n_points: int) -> None:
        # Of each viewpoint, in how many more images each point was held than bare; oldest first.
        self._held: dict[int, NDArray[np.int8]] = {}
        # (n,) from how many more viewpoints each point was held than bare.
        self._votes = np.zeros(n_points, np.int32)

    def add(self, viewpoint: int, tested: Bools, held: Bools) -> None:
        """Take an image from a viewpoint: which points (n,) it tells of, and which masks hold."""
        said = self._held.pop(viewpoint, None)
        if said is None:
            said = np.zeros(len(self._votes), np.int8)
        self._votes -= np.sign(said)
        said[tested & held] += 1
        said[tested & ~held] -= 1
        np.clip(said, -_MOST, _MOST, out=said)
        self._votes += np.sign(said)
        self._held[viewpoint] = said
        if len(self._held) > _KEPT:
            self._votes -= np.sign(self._held.pop(next(iter(self._held))))

    @property
    def n_viewpoints(self) -> int:
        """Places from which it was tested."""
        return len(self._held)

    @property
    def bare_share(self) -> float:
        """Share of the points that more viewpoints see bare than held."""
        return float((self._votes < 0).mean())
