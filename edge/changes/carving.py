# SPDX-License-Identifier: Apache-2.0
"""Which parts of an object's space masks of its kind leave bare.

Where a thing like it stands beside or behind an object, a mask over both says little of either from
one place: the other's mask may cover what has gone. From several places it cannot cover all of it,
while what is there is held by masks from everywhere (the visual hull: Laurentini 1994).
"""

import numpy as np
from numpy.typing import NDArray

from edge.types import F64, Bools

_MOST = 100  # images that one viewpoint counts
_KEPT = 300  # viewpoints, those seen from last: what is there now matters, and memory is finite


class Carving:
    """What was seen of the points of one object. Owned by one thread."""

    def __init__(self, n_points: int) -> None:
        # Of each viewpoint, in how many more images each point was held than bare; oldest first.
        self._held: dict[int, NDArray[np.int8]] = {}
        # (n,) from how many more viewpoints each point was held than bare.
        self._votes = np.zeros(n_points, np.int32)
        self._told = np.zeros(n_points, np.int32)  # from how many it was the one or the other

    def add(self, viewpoint: int, tested: Bools, held: Bools) -> None:
        """Take an image from a viewpoint: which points (n,) it tells of, and which masks hold."""
        said = self._held.pop(viewpoint, None)
        if said is None:
            said = np.zeros(len(self._votes), np.int8)
        self._count(said, -1)
        said[tested & held] += 1
        said[tested & ~held] -= 1
        np.clip(said, -_MOST, _MOST, out=said)
        self._count(said, 1)
        self._held[viewpoint] = said
        if len(self._held) > _KEPT:
            self._count(self._held.pop(next(iter(self._held))), -1)

    def _count(self, said: NDArray[np.int8], times: int) -> None:
        self._votes += times * np.sign(said)
        self._told += times * np.abs(np.sign(said))

    @property
    def n_viewpoints(self) -> int:
        """Places from which it was tested."""
        return len(self._held)

    def held_share(self, least: int) -> F64:
        """Of the viewpoints that tell of each point, how many more hold it than see it bare (n,).

        0 where fewer than `least` tell.
        """
        share: F64 = np.where(self._told >= least, self._votes / np.maximum(self._told, 1), 0.0)
        return share

    def n_bare(self, part: Bools) -> int:
        """Viewpoints from which more of some points (n,) were seen bare than held."""
        return sum(int(np.sign(said[part]).sum()) < 0 for said in self._held.values())

    @property
    def bare_share(self) -> float:
        """Share of the points that more viewpoints see bare than held."""
        return float((self._votes < 0).mean())
