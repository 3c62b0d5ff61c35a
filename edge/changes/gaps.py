# SPDX-License-Identifier: Apache-2.0
"""Surfaces of the map that measured depths are seen through, cell by cell."""

import numpy as np
from scipy.spatial import cKDTree

from edge.changes.cells import Keys
from edge.changes.clusters import clusters
from edge.changes.depths import View, seen_at
from edge.changes.mapped import Mapped
from edge.config.changes import ChangesConfig
from edge.types import F64, I32, Pinhole

_NEAREST, _BESIDE_PX = 6, 8.0  # depths that are asked about a cell, at most so far from it
_SIGMAS = 3.0
_THERE = 0.1  # as many viewpoints as see through a cell, that may see something in it
_LINK = 1.8  # cells: so near to each other they are of one thing
_LEAST_M = 0.3  # before the camera


class Gaps:
    """Counts viewpoints that see through cells, and that do not. Owned by one thread."""

    def __init__(self, mapped: Mapped, camera: Pinhole, config: ChangesConfig) -> None:
        self._mapped, self._camera, self._config = mapped, camera, config
        self._cells: Keys = np.empty(0, np.int64)
        self._through: I32 = np.empty(0, np.int32)  # (n,) viewpoints
        self._there: I32 = np.empty(0, np.int32)
        self._last: F64 = np.empty((0, 3))  # place of the last camera that told; NaN for none

    def carry_over(self) -> None:
        """Keep what is known of those cells that the map's surfaces still have."""
        cells = self._mapped.cells
        through, there = np.zeros(len(cells), np.int32), np.zeros(len(cells), np.int32)
        last = np.full((len(cells), 3), np.nan)
        _, new, old = np.intersect1d(cells, self._cells, assume_unique=True, return_indices=True)
        through[new], there[new] = self._through[old], self._there[old]
        last[new] = self._last[old]
        self._cells, self._through, self._there, self._last = cells, through, there, last

    def add(self, view: View) -> None:
        """Take the depths of a view, where it is another viewpoint for a cell."""
        settings, camera = self._config.geometry, self._camera
        if len(view.depth_m) < _NEAREST:
            return
        xyz = self._mapped.xyz
        pixels, depth = seen_at(view.T_map_cam, xyz, camera)
        inside = (depth > _LEAST_M) & (depth < settings.range_m)
        inside &= ((pixels > 0.0) & (pixels < (camera.width, camera.height))).all(axis=1)
        moved = np.linalg.norm(self._last - view.origin, axis=1)
        rows = np.flatnonzero(inside & ~(moved < self._config.presence.viewpoint_share * depth))
        own = depth[rows, None]
        reach_px = np.minimum(0.5 * settings.cell_m / own * camera.fx, _BESIDE_PX)
        apart, near = cKDTree(view.pixels).query(
            pixels[rows], _NEAREST, distance_upper_bound=_BESIDE_PX
        )
        further = np.append(view.depth_m, np.nan)[near] / own - 1.0
        further[apart >= reach_px] = np.nan
        slack = np.maximum(_SIGMAS * np.append(view.share, 0.0)[near], settings.cell_m / own)
        there = (np.abs(further) <= slack).any(axis=1)
        through = (further > slack).any(axis=1) & ~there
        self._there[rows] += there
        self._through[rows] += through
        self._last[rows[there | through]] = view.origin

    def groups(self) -> list[F64]:
        """Places (n, 3) of the cells of each thing that viewpoints see through."""
        settings = self._config.geometry
        gone = self._through >= settings.views
        gone &= self._there <= _THERE * self._through
        xyz = self._mapped.xyz[gone]
        link = np.full(len(xyz), _LINK * settings.cell_m)
        return [xyz[rows] for rows in clusters(xyz, link, settings.gone_cells)]
