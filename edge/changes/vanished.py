# SPDX-License-Identifier: Apache-2.0
"""Groups of points of the map that images show no more, and that depths are seen through.

Either alone is no proof: an edge looks different from elsewhere, and depths are sparse.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from edge.changes.clusters import clusters
from edge.changes.depths import View, ask, hull_of, seen_at, within
from edge.changes.expect import Sighting
from edge.changes.memory import PointMemory, Remembered
from edge.changes.presence import Presence
from edge.changes.proof import CONFIRMED
from edge.config.changes import ChangesConfig
from edge.types import F64, I32, Pinhole

_LINK = 0.07  # of their distance: points so near to each other are of one thing
_AROUND_PX = 50.0  # of a group, where other points tell whether the image is fit to judge
_FEW = 3
_AT_ONCE = 3  # large groups that are judged with a view, and small ones
_FLAT = 0.15  # of a group's length, that it must be thick
_THERE = 0.4  # as many depths as are behind it, that may be at its place: of what it stood on


class Gone(NamedTuple):
    """A group of points that is there no more."""

    points: I32
    xyz: F64  # (n, 3) [m]
    presence: Presence
    views: tuple[int, ...]  # numbers of those that show it gone


def find_gone(
    memory: PointMemory,
    views: Mapping[int, View],
    camera: Pinhole,
    seen_now: I32,
    config: ChangesConfig,
) -> list[Gone]:
    """Groups that are surely gone, of those that the last view shows points `seen_now` of.

    The largest groups each time, small ones in turn: they can wait for another view.
    """
    settings = config.geometry
    suspects = memory.suspects()
    groups = [
        rows
        for rows in clusters(suspects.xyz, _LINK * suspects.distance_m, settings.gone_points)
        if np.isin(suspects.points[rows], seen_now).any()
    ]
    groups.sort(key=len, reverse=True)
    large, small = groups[:_AT_ONCE], groups[_AT_ONCE:]
    turn = _AT_ONCE * max(views) % max(len(small), 1)
    found = []
    for rows in large + (small[turn:] + small[:turn])[:_AT_ONCE]:
        gone = _judge(_rows(suspects, rows), memory, views, camera, config)
        if gone is not None:
            found.append(gone)
    return found


def _rows(points: Remembered, rows: NDArray[np.int64]) -> Remembered:
    columns: list[Any] = [column[rows] for column in points]
    return Remembered(*columns)


def _judge(
    group: Remembered,
    memory: PointMemory,
    views: Mapping[int, View],
    camera: Pinhole,
    config: ChangesConfig,
) -> Gone | None:
    settings = config.geometry
    presence = Presence(config.presence)
    center = group.xyz.mean(axis=0)
    against: list[int] = []
    through = there = shown = seen_through = 0
    said = memory.said(group.points)
    sightings = {n: _sighting(counts, settings.gone_points) for n, counts in sorted(said.items())}
    if sum(sighting == "missed" for sighting in sightings.values()) < settings.views:
        return None
    for number, sighting in sightings.items():
        view = views.get(number)
        if view is None or view.control < settings.control_share:
            continue
        pixels, depth = seen_at(view, group.xyz, camera)
        if not np.isfinite(depth).all():
            continue
        hull = hull_of(pixels)
        told = ask(view, hull, float(depth.min()), float(depth.max()))
        if told.before > 0:
            continue  # it is hidden
        around = _control_around(view, pixels, group.points)
        if sighting == "missed" and around < settings.control_share:
            continue  # all about looks different
        distance = float(np.linalg.norm(view.origin - center))
        presence.add(sighting, view.origin, distance, around)
        there += told.there
        through += told.behind
        shown += sighting == "seen"
        if sighting == "missed":
            against.append(number)
            seen_through += told.behind > 0
    if not presence.is_gone:
        return None
    by_depths = seen_through >= settings.views and there <= _THERE * through
    by_image = (
        len(group.points) >= settings.gone_points_alone
        and presence.n_against >= settings.views_alone
        and shown == 0
        and seen_through > 0  # patches on a thin thing show what is behind it, from there another
        and there <= _THERE * (through + len(against))
        and _spread(views, against, center) > np.radians(settings.views_alone_deg)
        and _is_solid(group.xyz)
    )
    if not (by_depths or by_image):
        return None
    return Gone(group.points, group.xyz, presence, tuple(against))


def _control_around(view: View, pixels: F64, group: I32) -> float:
    """Share of the points around a group that a view confirms; 0 where there are too few."""
    ring = within(hull_of(pixels, _AROUND_PX), view.point_pixels)
    verdict = view.verdict[ring & ~np.isin(view.points, group)]
    return float((verdict == CONFIRMED).mean()) if len(verdict) >= _FEW else 0.0


def _spread(views: Mapping[int, View], numbers: list[int], center: F64) -> float:
    """Largest angle between the first of the views of a place and another [rad]."""
    if not numbers:
        return 0.0
    away = np.stack([views[number].origin for number in numbers]) - center
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    return float(np.arccos(np.clip(away @ away[0], -1.0, 1.0)).max())


def _is_solid(xyz: F64) -> bool:
    """Whether points do not lie on a plane, where a shadow may have fallen."""
    deviations = np.linalg.svd(xyz - xyz.mean(axis=0), compute_uv=False)
    return bool(deviations[2] > _FLAT * deviations[0])


def _sighting(counts: tuple[int, int, int], least: int) -> Sighting:
    same, unclear, other = counts
    tested = same + unclear + other
    if 4 * same > tested:
        return "seen"
    gone = other >= max(2, least // 2) and 10 * other >= 6 * tested and 10 * same <= tested
    return "missed" if gone else "unclear"
