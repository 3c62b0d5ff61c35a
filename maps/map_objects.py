# SPDX-License-Identifier: Apache-2.0
"""Objects of a map: masks in many images that hold the same points.

By geometry first, and the name last: detectors rename things from image to image, but a cup does
not move between two images of a map. Two masks are compared on the points that both images see,
so that a thing that is half out of one image is still the same thing.
"""

from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from edge.changes.cover import find_cover
from edge.changes.expect import MapObject
from edge.types import F32, F64, I32, Detections, Mat4

MIN_VIEWS = 3  # that agree; more than a third of what detectors see, they see once only
_MIN_POINTS = 4  # in a mask, and in common with an object
_SAME = 0.5  # of the points of both, those in both


class View(NamedTuple):
    """One image of the map."""

    points: I32  # (n,) numbers of the points that it sees, each once
    pixels: F32  # (n, 2) where, in the pixels of the image that was segmented
    T_map_cam: Mat4
    detections: Detections


class _Group:
    """Masks that are of one object, as far as is known."""

    def __init__(self) -> None:
        self.hits: Counter[int] = Counter()
        self.views: list[int] = []
        self.names: Counter[int] = Counter()

    def core(self, seen_by: Sequence[set[int]]) -> set[int]:
        """Points that at least half of its views that see them have in their masks."""
        sets = [seen_by[v] for v in self.views]
        return {p for p, hits in self.hits.items() if 2 * hits >= sum(p in s for s in sets)}


def group_objects(views: Sequence[View], xyz: F64) -> list[MapObject]:
    """Objects that at least MIN_VIEWS images agree on, in the order in which they appear.

    xyz  (P, 3)  float64  places of all points in the map [m]
    """
    seen_by = [set(view.points.tolist()) for view in views]
    groups: list[_Group] = []
    holders: defaultdict[int, set[int]] = defaultdict(set)  # groups that hold a point
    for v, view in enumerate(views):
        for label, members in _masks(view):
            near = {g for p in members for g in holders[p] if v not in groups[g].views}
            best = _find_group(members, [groups[g] for g in sorted(near)], seen_by, v)
            if best is None:
                best = _Group()
                groups.append(best)
            best.hits.update(members)
            best.views.append(v)
            best.names[label] += 1
            number = groups.index(best)
            for p in members:
                holders[p].add(number)
    made = (_make(group, views, seen_by, xyz) for group in groups if len(group.views) >= MIN_VIEWS)
    return [thing for thing in made if thing is not None]


def _masks(view: View) -> Iterator[tuple[int, set[int]]]:
    """Class and points of each mask, best first."""
    owner = find_cover(view.detections, view.pixels)
    for i, label in enumerate(view.detections.classes):
        members = set(view.points[owner == i].tolist())
        if len(members) >= _MIN_POINTS:
            yield int(label), members


def _find_group(
    members: set[int], groups: Sequence[_Group], seen_by: Sequence[set[int]], v: int
) -> _Group | None:
    """The group that a mask of view `v` belongs to; None where it is of none."""
    best, best_share = None, _SAME
    for group in groups:
        core = group.core(seen_by) & seen_by[v]
        known = {p for p in members if any(p in seen_by[w] for w in group.views)}
        both = len(core & known)
        share = both / max(len(core | known), 1)
        if both >= _MIN_POINTS and share >= best_share:
            best, best_share = group, share
    return best


def _make(
    group: _Group, views: Sequence[View], seen_by: Sequence[set[int]], xyz: F64
) -> MapObject | None:
    points = sorted(p for p in group.core(seen_by) if group.hits[p] >= MIN_VIEWS)
    if len(points) < _MIN_POINTS:
        return None
    places = xyz[points]
    cameras = np.stack([views[v].T_map_cam[:3, 3] for v in group.views])
    away = cameras - np.median(places, axis=0)
    distances = np.linalg.norm(away, axis=1)
    # Views that see most of its points, and still have no mask of it, are the model's misses.
    shown = {v for v, s in enumerate(seen_by) if 2 * sum(p in s for p in points) >= len(points)}
    label = min(group.names, key=lambda name: (-group.names[name], name))
    return MapObject(
        label=label,
        points=places,
        view_directions=away / distances[:, None],
        view_distance_m=float(distances.max()),
        hit_rate=len(shown & set(group.views)) / max(len(shown), 1),
    )
