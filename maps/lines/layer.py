# SPDX-License-Identifier: Apache-2.0
"""The lines of a map as the compiler holds them, and as tiles do."""

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from edge.lines.line import Lines, across
from edge.tiles.format import Array
from edge.tiles.lines import LOWER
from edge.tiles.reader import Map
from edge.types import F64, I32, Bools
from maps.extra import Sizes
from maps.lines.twins import without_twins

if TYPE_CHECKING:
    from maps.layers import TileContent

I64 = NDArray[np.int64]


class LineLayer(NamedTuple):
    """All lines of a map, and the views that see them. At least one view sees each line."""

    point: F64  # (n, 3)
    direction: F64  # (n, 3) float32 numbers, of unit length to their precision
    span: F64  # (n, 2)
    lower: F64  # (n, 10) of the covariance
    n_views: I64  # (n,)
    view: I32  # (m,) ascending, and for each view its lines, ascending:
    line: I32  # (m,)

    @classmethod
    def of(cls, lines: Lines, span: F64, n_views: I64, seen: tuple[I32, I32]) -> "LineLayer":
        """Layer of lines, seen by views (m,) as line (m,)."""
        # A covariance is told across a direction: that which a reader will find.
        direction = lines.direction.astype(np.float32).astype(np.float64)
        unit = direction / np.linalg.norm(direction, axis=1, keepdims=True)
        turn = np.einsum("nai,nbi->nab", across(unit), across(lines.direction))
        both = np.zeros((len(turn), 4, 4))
        both[:, :2, :2] = both[:, 2:, 2:] = turn
        lower = np.linalg.cholesky(both @ lines.covariance @ both.transpose(0, 2, 1))
        order = np.lexsort((seen[1], seen[0]))
        return cls(
            lines.point,
            direction,
            span,
            np.asarray(lower[:, LOWER[0], LOWER[1]], np.float64),
            n_views,
            seen[0][order].astype(np.int32),
            seen[1][order].astype(np.int32),
        )

    @classmethod
    def load(cls, opened: Map, keyframes: I32) -> "LineLayer | None":
        """The lines of a map, in its order."""
        if opened.lines.count == 0:
            return None
        seen = [opened.lines.seen_by(int(k)) for k in keyframes]
        tiles = [tile for tile in opened.tiles if tile.entry.lines]
        found = opened.lines.take(np.arange(opened.lines.count, dtype=np.int32))

        def stored(name: str) -> F64:
            return np.concatenate([tile[name] for tile in tiles]).astype(np.float64)

        return cls(
            found.lines.point,
            stored("lines/direction"),
            found.span,
            stored("lines/sigma"),
            found.n_views.astype(np.int64),
            np.repeat(np.arange(len(seen), dtype=np.int32), [len(lines) for lines in seen]),
            np.concatenate([np.empty(0, np.int32), *seen]),
        )

    @classmethod
    def joined(
        cls, first: "LineLayer | None", second: "LineLayer | None", sizes: tuple[Sizes, Sizes]
    ) -> "LineLayer":
        """The lines of both, each of them once."""
        a, b = first or cls._nothing(), second or cls._nothing()
        point, direction, span, lower = (
            np.concatenate(pair) for pair in zip(a[:4], b[:4], strict=True)
        )
        both = cls(
            point,
            direction,
            span,
            lower,
            np.concatenate((a.n_views, b.n_views)),
            np.concatenate((a.view, b.view + np.int32(sizes[0].views))),
            np.concatenate((a.line, b.line + np.int32(len(a.point)))),
        )
        return without_twins(both)

    def kept(self, view: I32, point: I32) -> "LineLayer":
        """The lines that the views which stay see."""
        del point  # lines are not made of points
        rows = view[self.view] >= 0
        return self._replace(view=view[self.view[rows]], line=self.line[rows]).numbered()

    def without(self, doubtful: Bools) -> "LineLayer":
        """The lines that are not `doubtful` (n,)."""
        rows = ~doubtful[self.line]
        return self._replace(view=self.view[rows], line=self.line[rows]).numbered()

    def numbered(self) -> "LineLayer":
        """Only the lines that some view sees, numbered anew."""
        left, line = np.unique(self.line, return_inverse=True)
        return LineLayer(
            self.point[left],
            self.direction[left],
            self.span[left],
            self.lower[left],
            self.n_views[left],
            self.view,
            line.astype(np.int32),
        )

    def arrays(self, content: "TileContent") -> dict[str, Array]:
        """The arrays of one tile; a line belongs to that of the first view which sees it."""
        tile_of_view, number = content.keyframe_places.tile, content.number
        tile, local = self._places(tile_of_view)
        own = np.flatnonzero(tile == number)
        rows = np.flatnonzero(tile_of_view[self.view] == number)
        line = self.line[rows]
        # In the order in which a reader will number them.
        order = np.lexsort((local[line], tile[line], self.view[rows]))
        line = line[order]
        stored = local[line].astype(np.int64)
        away = np.flatnonzero(tile[line] != number)
        others = np.unique(np.column_stack((tile[line[away]], local[line[away]])), axis=0)
        link = {(int(t), int(k)): row for row, (t, k) in enumerate(others)}
        for row in away:
            stored[row] = -1 - link[int(tile[line[row]]), int(local[line[row]])]
        counts = np.bincount(self.view[rows], minlength=len(tile_of_view))[content.keyframes]
        return {
            "lines/point": (self.point[own] - content.origin).astype(np.float32),
            "lines/direction": self.direction[own].astype(np.float32),
            "lines/span": self.span[own].astype(np.float32),
            "lines/sigma": self.lower[own].astype(np.float32),
            "lines/n_views": np.minimum(self.n_views[own], 65535).astype(np.uint16),
            "lines/offsets": np.concatenate([[0], np.cumsum(counts)]).astype(np.uint32),
            "lines/seen": stored.astype(np.int32),
            "lines/link": others.reshape(-1, 2).astype(np.uint32),
        }

    def _places(self, tile_of_view: I32) -> tuple[I32, I32]:
        """Tile of each line, and its index there."""
        order = np.argsort(self.line, kind="stable")  # the views of each stay ascending
        _, first = np.unique(self.line[order], return_index=True)
        tile = tile_of_view[self.view[order[first]]]
        local = np.zeros(len(tile), np.int32)
        for number in np.unique(tile):
            members = np.flatnonzero(tile == number)
            local[members] = np.arange(len(members))
        return tile, local

    @classmethod
    def _nothing(cls) -> "LineLayer":
        none, three = np.empty(0, np.int32), np.empty((0, 3))
        counts = np.empty(0, np.int64)
        return cls(three, three, np.empty((0, 2)), np.empty((0, 10)), counts, none, none)
