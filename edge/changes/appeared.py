# SPDX-License-Identifier: Apache-2.0
"""Groups of measured depths where the map saw free space, and that hide points of the map."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from edge.changes.clusters import clusters
from edge.changes.depths import View, hull_of, points_of, seen_at, slack_of, within
from edge.changes.free_space import MapRays
from edge.changes.presence import Presence
from edge.changes.proof import CONFIRMED, CONTRADICTED
from edge.config.changes import ChangesConfig
from edge.types import F64, I32, Bools, Pinhole

_LINK = 0.04  # of their distance: depths so near to each other are of one thing
_AROUND_PX = 20.0  # of a depth, within which points of the map may be hidden with it
_ASKED = 4  # of these, the nearest
_BESIDE_PX = 10.0  # of a group's outline, where points may be hidden
_HIT_RATE = 0.7  # of views in which a thing hides what is behind it
_MOST = 4000  # depths that are remembered


class New(NamedTuple):
    """A group of depths where there was nothing."""

    xyz: F64  # (n, 3) [m]
    presence: Presence
    views: tuple[int, ...]  # numbers of those that show it


class Unexplained:
    """Depths before points of the map that are not shown. Owned by one thread."""

    def __init__(self, camera: Pinhole, rays: MapRays, config: ChangesConfig) -> None:
        self._camera, self._rays, self._config = camera, rays, config
        self._xyz: F64 = np.empty((0, 3))
        self._link: F64 = np.empty(0)
        self._view: I32 = np.empty(0, np.int32)

    def add(self, view: View) -> None:
        """Take the depths of a view that its points of the map do not explain."""
        chosen = np.flatnonzero(_hiding(view))
        if len(chosen) == 0:
            return
        xyz = points_of(view, self._camera)[chosen]
        free = self._rays.are_free(xyz, view.origin)
        chosen, xyz = chosen[free], xyz[free]
        self._xyz = np.concatenate((self._xyz, xyz))[-_MOST:]
        self._link = np.concatenate((self._link, _LINK * view.depth_m[chosen]))[-_MOST:]
        number = np.full(len(chosen), view.number, np.int32)
        self._view = np.concatenate((self._view, number))[-_MOST:]

    def find(self, views: Mapping[int, View], newest: int) -> list[New]:
        """All groups that are surely new, of those that the newest view has depths of."""
        settings = self._config.geometry
        kept = self._view > newest - len(views)
        self._xyz, self._link, self._view = self._xyz[kept], self._link[kept], self._view[kept]
        found = []
        for rows in clusters(self._xyz, self._link, settings.new_depths):
            numbers = np.unique(self._view[rows])
            if newest in numbers and len(numbers) >= settings.new_views:
                new = self._judge(rows, views)
                if new is not None:
                    found.append(new)
        return found

    def forget(self, new: New) -> None:
        """Drop the depths of a group."""
        low, high = new.xyz.min(axis=0) - 1e-9, new.xyz.max(axis=0) + 1e-9
        kept = ~((self._xyz >= low) & (self._xyz <= high)).all(axis=1)
        self._xyz, self._link, self._view = self._xyz[kept], self._link[kept], self._view[kept]

    def _judge(self, rows: NDArray[np.int64], views: Mapping[int, View]) -> New | None:
        config, settings = self._config, self._config.geometry
        xyz = self._xyz[rows]
        fit = {n: v for n, v in views.items() if v.control >= settings.control_share}
        behind = {n: _behind(v, xyz, self._camera) for n, v in fit.items() if n in self._view[rows]}
        against = [n for n, (own, shown) in behind.items() if len(own) > 2 * len(shown)]
        hidden = {point for n in against for point in behind[n][0].tolist()}
        if len(against) < settings.new_views or len(hidden) < settings.hidden_points:
            return None
        presence = Presence(config.presence, config.presence.new_log_odds)
        center = np.median(xyz, axis=0)
        for number, view in fit.items():
            own, shown = behind.get(number) or _behind(view, xyz, self._camera)
            distance = float(np.linalg.norm(view.origin - center))
            if len(shown) > len(own):
                presence.add("missed", view.origin, distance, _HIT_RATE)
            elif number in against:
                presence.add("seen", view.origin, distance, _HIT_RATE)
        if not presence.is_there:
            return None
        cameras = np.stack([views[number].origin for number in against])
        if not self._rays.was_free(xyz, cameras):
            return None
        return New(xyz, presence, tuple(against))


def _hiding(view: View) -> Bools:
    """Which depths (n,) lie before points of the map that the view does not show."""
    lost = view.verdict == CONTRADICTED
    nothing: Bools = np.zeros(len(view.depth_m), bool)
    if not lost.any() or len(view.depth_m) == 0:
        return nothing
    tree = cKDTree(view.point_pixels[lost])
    _, rows = tree.query(view.pixels, _ASKED, distance_upper_bound=_AROUND_PX)
    depth = np.append(view.point_depth_m[lost], 0.0)[rows]  # none is no depth
    hiding: Bools = (depth > (view.depth_m * (1.0 + slack_of(view.share)))[:, None]).any(axis=1)
    return hiding


def _behind(view: View, xyz: F64, camera: Pinhole) -> tuple[I32, I32]:
    """Points of the map behind a group: those that the view contradicts, and those it confirms."""
    pixels, depth = seen_at(view, xyz, camera)
    none = np.empty(0, np.int32)
    if not np.isfinite(depth).all():
        return none, none
    behind = view.point_depth_m > depth.max() * (1.0 + slack_of(np.zeros(1))[0])
    own = behind & (view.verdict == CONTRADICTED)
    own &= within(hull_of(pixels, _BESIDE_PX), view.point_pixels)  # depths are on its outline
    shown = behind & (view.verdict == CONFIRMED) & within(hull_of(pixels), view.point_pixels)
    return view.points[own], view.points[shown]
