# SPDX-License-Identifier: Apache-2.0
"""The lines of a map: an optional layer of its tiles."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edge.lines.line import Lines
from edge.tiles.manifest import TileEntry
from edge.tiles.tile import Tile
from edge.types import F64, I32

# Of (n, 10) rows: the lower triangle, row by row.
LOWER = np.tril_indices(4)

I64 = NDArray[np.int64]


class MapLines(NamedTuple):
    """Some lines of a map, in the order in which they were asked for."""

    lines: Lines  # in the map frame; brighter on the side of the projected (dv, -du)
    span: F64  # (n, 2) the part that was seen, from the point, along the direction [m]
    n_views: I32  # (n,) that agree on it


class LineTable:
    """Finds the lines of a map, and which keyframes see them. Read-only; for any thread."""

    def __init__(
        self, entries: Sequence[TileEntry], keyframe_base: I64, visit: Callable[[int], Tile]
    ) -> None:
        """`visit` gives the tile of a place in `entries`, whose layers are then read."""
        self._visit = visit
        self._keyframe_base = keyframe_base
        self._base = np.concatenate([[0], np.cumsum([e.lines for e in entries], dtype=np.int64)])
        self._order = {entry.id: order for order, entry in enumerate(entries)}
        self.count = int(self._base[-1])  # 0: the map has no lines

    def seen_by(self, k: int) -> I32:
        """Global indices (n,) of the lines that keyframe `k` sees, ascending."""
        if not 0 <= k < self._keyframe_base[-1]:
            raise IndexError(f"the map has keyframes 0 to {self._keyframe_base[-1] - 1}")
        order = int(np.searchsorted(self._keyframe_base, k, side="right")) - 1
        if self.count == 0:
            return np.empty(0, np.int32)
        tile = self._visit(order)
        if "lines/seen" not in tile.layers:
            return np.empty(0, np.int32)
        row = tile.row("lines/offsets", k - int(self._keyframe_base[order]))
        stored = tile["lines/seen"][row].astype(np.int64)
        links = tile["lines/link"].astype(np.int64)
        if stored.size and not -1 - len(links) < stored.min() <= stored.max() < tile.entry.lines:
            raise tile.damaged("lines/seen")
        found = stored + self._base[order]
        away = np.flatnonzero(stored < 0)
        ids, local = links[-1 - stored[away]].T
        orders = np.array([self._order.get(int(i), -1) for i in ids], np.int64)
        if np.any(orders < 0) or np.any(local >= np.diff(self._base)[orders]):
            raise tile.damaged("lines/link")
        found[away] = self._base[orders] + local
        return np.unique(found).astype(np.int32)

    def take(self, indices: I32) -> MapLines:
        """Return the lines of the global `indices` (n,)."""
        indices = np.asarray(indices, np.int64)
        if indices.size and not 0 <= indices.min() <= indices.max() < self.count:
            raise IndexError(f"the map has lines 0 to {self.count - 1}")
        n = len(indices)
        out = MapLines(
            Lines(np.empty((n, 3)), np.empty((n, 3)), np.empty((n, 4, 4))),
            np.empty((n, 2)),
            np.empty(n, np.int32),
        )
        owner = np.searchsorted(self._base, indices, side="right") - 1
        for order in np.unique(owner):
            rows = np.flatnonzero(owner == order)
            _read(self._visit(int(order)), indices[rows] - self._base[order], rows, out)
        return out


def _read(tile: Tile, local: I64, rows: I64, out: MapLines) -> None:
    """Copy lines of one tile into the rows of `out`."""
    lower = np.zeros((len(local), 4, 4))
    direction = tile["lines/direction"][local].astype(np.float64)
    with np.errstate(all="ignore"):
        out.lines.point[rows] = tile["lines/point"][local] + np.array(tile.entry.origin_m)
        norm = np.linalg.norm(direction, axis=1, keepdims=True)
        out.lines.direction[rows] = direction / norm
        lower[:, LOWER[0], LOWER[1]] = tile["lines/sigma"][local]
        out.lines.covariance[rows] = lower @ lower.transpose(0, 2, 1)
    out.span[rows] = tile["lines/span"][local]
    out.n_views[rows] = tile["lines/n_views"][local]
    finite = all(np.isfinite(array[rows]).all() for array in (*out.lines, out.span))
    if not (finite and np.all(np.abs(norm - 1.0) < 1e-3)):
        raise tile.damaged("lines")
