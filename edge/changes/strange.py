# SPDX-License-Identifier: Apache-2.0
"""Measured depths far from all surfaces of the map, where the map saw free space, cell by cell."""

import numpy as np

from edge.changes.cells import cell_keys
from edge.changes.clusters import clusters
from edge.changes.depths import View
from edge.changes.mapped import Mapped
from edge.config.changes import ChangesConfig
from edge.types import F64

_SIGMAS = 3.0
_THERE = 0.02  # as many of the map's depths as lie behind a cell, that may lie in it
_LINK = 2.2  # cells: so near to each other they are of one thing
_LEAST = 0.5  # as much as is asked of a thing's cells on average, each must have
_VIEWPOINTS = 12  # of a cell, that are remembered
_MOST = 20_000  # cells that are remembered


class _Cell:
    """What was measured in one cell."""

    __slots__ = ("asked", "behind", "count", "origins", "there", "total")

    def __init__(self) -> None:
        self.total, self.count = np.zeros(3), 0
        self.origins: list[F64] = []  # of the cameras of its viewpoints
        self.asked = 0  # viewpoints, when the map was asked
        self.behind = self.there = 0  # depths of the map

    @property
    def middle(self) -> F64:
        """Of what was measured (3,) [m]."""
        return self.total / self.count

    @property
    def towards(self) -> F64:
        """Directions (_VIEWPOINTS, 3) to its cameras; zeros for none."""
        away = np.stack(self.origins) - self.middle
        directions = np.zeros((_VIEWPOINTS, 3))
        directions[: len(away)] = away / np.linalg.norm(away, axis=1, keepdims=True)
        return directions


class Strange:
    """Cells that the map knows nothing of. Owned by one thread."""

    def __init__(self, mapped: Mapped, config: ChangesConfig) -> None:
        self._mapped, self._config = mapped, config
        self._cells: dict[int, _Cell] = {}  # the last measured come last

    def add(self, view: View) -> None:
        """Take the depths of a view that no surface of the map explains."""
        settings = self._config.geometry
        near = np.flatnonzero(view.depth_m < settings.range_m)
        slack = np.maximum(settings.cell_m, _SIGMAS * view.share[near] * view.depth_m[near])
        rows = near[self._mapped.distance(view.xyz[near]) > slack]
        xyz = view.xyz[rows]
        apart = self._config.presence.viewpoint_share * view.depth_m[rows]
        keys = cell_keys(xyz, settings.cell_m).tolist()
        for key, place, far in zip(keys, xyz, apart.tolist(), strict=True):
            cell = self._cells.pop(key, None) or _Cell()
            self._cells[key] = cell
            cell.total += place
            cell.count += 1
            if not cell.origins or np.linalg.norm(cell.origins[-1] - view.origin) > far:
                cell.origins = [*cell.origins[-_VIEWPOINTS + 1 :], view.origin]
        self._ask([self._cells[key] for key in set(keys)])
        while len(self._cells) > _MOST:
            del self._cells[next(iter(self._cells))]

    def _ask(self, cells: list[_Cell]) -> None:
        """Let the map say what it saw there, once there are enough viewpoints and then more."""
        views = self._config.geometry.views
        due = [c for c in cells if len(c.origins) >= max(views, min(2 * c.asked, _VIEWPOINTS))]
        due = [c for c in due if c.asked < len(c.origins)]
        if not due:
            return
        middles = np.stack([cell.middle for cell in due])
        towards = np.stack([cell.towards for cell in due])
        behind, there = self._mapped.seen_through(middles, towards)
        for i, cell in enumerate(due):
            cell.asked = len(cell.origins)
            cell.behind, cell.there = int(behind[i]), int(there[i])

    def groups(self) -> list[F64]:
        """Places (n, 3) of the cells of each thing where the map saw free space."""
        settings = self._config.geometry
        free = [
            cell
            for cell in self._cells.values()
            if cell.behind >= _LEAST * settings.seen_through and cell.there <= _THERE * cell.behind
        ]
        if not free:
            return []
        xyz = np.stack([cell.middle for cell in free])
        behind = np.array([cell.behind for cell in free])
        link = np.full(len(xyz), _LINK * settings.cell_m)
        return [
            xyz[rows]
            for rows in clusters(xyz, link, settings.new_cells)
            if behind[rows].mean() >= settings.seen_through
        ]
