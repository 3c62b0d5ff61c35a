# SPDX-License-Identifier: Apache-2.0
"""Which tiles are in memory: a bound in bytes, and reading ahead of the camera."""

import threading
from collections.abc import Sequence

import numpy as np

from edge.tiles.tile import Tile
from edge.types import F64

DEFAULT_BYTES = 64_000_000
# An index of the words larger than this share of the bound is read anew by each search.
_INDEX_SHARE = 0.5
# The kernel reads ahead no more than this share of what tiles may hold: the rest is in use.
_AHEAD_SHARE = 0.25


class Residency:
    """Gives tiles' memory back, the least recently visited first; for any thread.

    What counts is what a tile could hold at most, so that the bound holds whatever is touched of
    it. Only the tile that is being visited may go beyond: without it nothing could be read.
    """

    def __init__(self, tiles: Sequence[Tile], limit_bytes: int) -> None:
        self._tiles = tiles
        self._boxes = _camera_boxes(tiles)
        self._used: dict[int, int] = {}  # bytes; the last one was visited last
        self._total = 0
        self._ahead: frozenset[int] = frozenset()
        self._lock = threading.Lock()
        self.keeps_index, self._limit = True, limit_bytes
        self.bound(limit_bytes)

    def bound(self, limit_bytes: int) -> None:
        """Hold no more than this from now on."""
        with self._lock:
            while self._used:
                self._give_back(next(iter(self._used)))
            index = sum(tile.index_bytes for tile in self._tiles)
            self.keeps_index = index <= _INDEX_SHARE * limit_bytes
            self._limit = limit_bytes - index if self.keeps_index else limit_bytes
            if not self.keeps_index:
                for tile in self._tiles:
                    tile.release(index=True)

    def visit(self, order: int) -> Tile:
        """Return the tile, whose layers are about to be read; BadChecksum if it is damaged."""
        tile = self._tiles[order]
        tile.check()
        with self._lock:
            size = self._used.pop(order, None)
            if size is None:
                size = tile.place_bytes if self.keeps_index else tile.bytes
                self._total += size
                while self._used and self._total > self._limit:
                    self._give_back(next(iter(self._used)))
            self._used[order] = size
        return tile

    def searched(self, order: int) -> None:
        """The index of the tile was read, and the search goes on to another."""
        if not self.keeps_index:
            with self._lock:
                if order not in self._used:
                    self._tiles[order].release(index=True)

    def expect(self, place: F64, reach_m: float) -> None:
        """Have the kernel read, in the background, what lies within `reach_m` of `place` (3,)."""
        away = np.maximum(self._boxes[0] - place, place - self._boxes[1]).max(axis=1)
        near = np.flatnonzero(away <= reach_m)
        ahead: list[int] = []
        left = _AHEAD_SHARE * self._limit
        for order in near[np.argsort(away[near], kind="stable")].tolist():
            left -= self._tiles[order].place_bytes
            if left < 0 and ahead:
                break
            ahead.append(order)
        for order in ahead:
            if order not in self._ahead and order not in self._used:
                self._tiles[order].read_ahead()
        self._ahead = frozenset(ahead)

    def _give_back(self, order: int) -> None:
        self._total -= self._used.pop(order)
        self._tiles[order].release(index=not self.keeps_index)


def _camera_boxes(tiles: Sequence[Tile]) -> tuple[F64, F64]:
    """Least and greatest coordinates (n, 3) of the tiles' keyframes; of none, nowhere."""
    least, greatest = np.full((len(tiles), 3), np.inf), np.full((len(tiles), 3), -np.inf)
    for order, tile in enumerate(tiles):
        centres = tile["keyframes/T_map_cam"][:, :3, 3]
        if len(centres):
            least[order], greatest[order] = centres.min(axis=0), centres.max(axis=0)
    return least, greatest
