# SPDX-License-Identifier: Apache-2.0
"""Objects of a map: masks in many images that hold the same points, or lie at one place.

By geometry first, and the name last: detectors rename things from image to image, but a cup does
not move between two images of a map. Masks of things with texture are compared on the points that
both images see, so that a thing that is half out of one image is still the same thing; masks of
plain things by where their lines of sight meet.
"""

from collections import Counter
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from edge.changes.cover import between, find_cover, holds
from edge.changes.glimpse import Glimpse
from edge.changes.place import Place, carve, fits, locate
from edge.geometry import se3
from edge.geometry.camera import CameraModel
from edge.tiles.labels import MapObject
from edge.types import F32, F64, I32, Detections, Mask, Mat4

MIN_VIEWS = 3  # that agree; more than a third of what detectors see, they see once only
_MIN_POINTS = 4  # in a mask, and in common with an object
_SAME = 0.5  # of the points of both, those in both
_MIN_PLACES = 4  # that all masks hold: else they are of no one thing
_SHOWN = 0.7  # of an object's space, inside an image that must show it
_NEARER = 0.9  # of its distance: what is nearer hides it
_SEEN, _MISSED = 0.4, 0.1  # of its space under one mask
_ALIKE = 0.4  # the boxes of a thing and of its mask, whatever its name, overlap by so much
_LARGER = 2.0  # times its own box: of what it stands on or before
_COMMON = 0.2  # of its images, in which what is one thing may be two masks
_BASELINE_RAD = 0.05  # between two lines of sight of which nothing else is known


class View(NamedTuple):
    """One image of the map."""

    points: I32  # (n,) numbers of the points that it sees, each once
    pixels: F32  # (n, 2) where, in the pixels of the image that was segmented
    T_map_cam: Mat4
    camera: CameraModel
    detections: Detections
    glimpses: list[Glimpse]  # the same, in their order
    surface_pixels: F32  # (m, 2) where the depth of the scene is known
    surface_m: F64  # (m,) that depth


class _Group:
    """Masks that are of one object, as far as is known."""

    def __init__(self) -> None:
        self.hits: Counter[int] = Counter()
        self.views: list[int] = []
        self.names: Counter[int] = Counter()
        self.glimpses: list[Glimpse] = []
        self.place: Place | None = None

    def add(self, v: int, glimpse: Glimpse, members: set[int]) -> None:
        """Take a mask of view `v`."""
        self.hits.update(members)
        self.views.append(v)
        self.names[glimpse.label] += 1
        self.glimpses.append(glimpse)
        if len(self.glimpses) > 1 or np.isfinite(glimpse.distance_m):
            self.place = locate(self.glimpses)

    def take_in(self, other: "_Group") -> None:
        """Take the masks of another group, but of images that this one has a mask of."""
        self.hits.update(other.hits)
        self.names.update(other.names)
        for v, glimpse in zip(other.views, other.glimpses, strict=True):
            if v not in self.views:
                self.views.append(v)
                self.glimpses.append(glimpse)
        self.place = locate(self.glimpses)

    def core(self, seen_by: Sequence[set[int]]) -> set[int]:
        """Points that at least half of its views that see them have in their masks."""
        sets = [seen_by[v] for v in self.views]
        return {p for p, hits in self.hits.items() if 2 * hits >= sum(p in s for s in sets)}


def group_objects(views: Sequence[View]) -> list[MapObject]:
    """Objects that at least MIN_VIEWS images agree on, in the order in which they appear."""
    seen_by = [set(view.points.tolist()) for view in views]
    groups: list[_Group] = []
    for v, view in enumerate(views):
        masks = list(_masks(view))
        for (glimpse, members), group in zip(
            masks, _assign(masks, groups, seen_by, v), strict=True
        ):
            if group is None:
                group = _Group()
                groups.append(group)
            group.add(v, glimpse, members)
    joined = _join(groups)
    made = (_make(group, views) for group in joined if len(group.views) >= MIN_VIEWS)
    return [thing for thing in made if thing is not None]


def _masks(view: View) -> Iterator[tuple[Glimpse, set[int]]]:
    """Each mask and the points in it, best first."""
    owner = find_cover(view.detections, view.pixels)
    for i, glimpse in enumerate(view.glimpses):
        yield glimpse, set(view.points[owner == i].tolist())


def _assign(
    masks: Sequence[tuple[Glimpse, set[int]]],
    groups: Sequence[_Group],
    seen_by: Sequence[set[int]],
    v: int,
) -> list[_Group | None]:
    """The group of each mask of view `v`, the surest first; None where it is of none."""
    pairs = [
        (-score, i, g)
        for i, (glimpse, members) in enumerate(masks)
        for g, group in enumerate(groups)
        if (score := _likeness(glimpse, members, group, seen_by, v)) > 0.0
    ]
    chosen: dict[int, int] = {}
    for _, i, g in sorted(pairs):
        if i not in chosen and g not in chosen.values():
            chosen[i] = g
    return [groups[chosen[i]] if i in chosen else None for i in range(len(masks))]


def _likeness(
    glimpse: Glimpse, members: set[int], group: _Group, seen_by: Sequence[set[int]], v: int
) -> float:
    """How surely a mask is of a group: above 1 by the points of both, up to 1 by its place."""
    if not members.isdisjoint(group.hits):
        core = group.core(seen_by) & seen_by[v]
        known = {p for p in members if any(p in seen_by[w] for w in group.views)}
        share = len(core & known) / max(len(core | known), 1)
        if len(core & known) >= _MIN_POINTS and share >= _SAME:
            return 1.0 + share
    if glimpse.label not in group.names:
        return 0.0
    if group.place is not None:
        return fits(glimpse, group.place)
    return _fit_of_two(group.glimpses[0], glimpse)


def _join(groups: Sequence[_Group]) -> list[_Group]:
    """Groups without those that are parts of others at their place: the larger take them in."""
    order = sorted(range(len(groups)), key=lambda g: (-len(groups[g].views), g))
    kept: list[int] = []
    for g in order:
        group = groups[g]
        home = next((k for k in kept if _are_one(groups[k], group)), None)
        if home is None:
            kept.append(g)
        else:
            groups[home].take_in(group)
    return [groups[g] for g in sorted(kept)]


def _are_one(larger: _Group, smaller: _Group) -> bool:
    """Whether two groups are at one place, of like size, and hardly ever in one image."""
    if larger.place is None or smaller.place is None:
        return False
    common = len(set(larger.views) & set(smaller.views))
    if common > _COMMON * len(smaller.views):
        return False
    apart = float(np.linalg.norm(larger.place.center - smaller.place.center))
    radii = larger.place.radius_m, smaller.place.radius_m
    return apart < 0.8 * max(radii) and max(radii) < 2.0 * min(radii)


def _fit_of_two(one: Glimpse, other: Glimpse) -> float:
    """How well two lines of sight meet, of which no distance is known."""
    if float(np.arccos(np.clip(one.ray @ other.ray, -1.0, 1.0))) < _BASELINE_RAD:
        return 0.0
    place = locate([one, other])
    if place is None or place.sigma_m > 0.3 * np.linalg.norm(place.center - other.origin):
        return 0.0
    return 0.5 * min(fits(one, place, 1.4), fits(other, place, 1.4))


def _make(group: _Group, views: Sequence[View]) -> MapObject | None:
    place = group.place
    if place is None:
        return None
    points = carve(group.glimpses, place)
    if len(points) < _MIN_PLACES:
        return None
    label = min(group.names, key=lambda name: (-group.names[name], name))
    cameras, found = [], []
    for v, view in enumerate(views):
        was_found = v in group.views or _was_seen(points, view, label)
        if was_found is not None:
            cameras.append(view.T_map_cam[:3, 3])
            found.append(was_found)
    return MapObject(label, points, np.stack(cameras), np.array(found, bool))


def _was_seen(points: F64, view: View, label: int) -> bool | None:
    """Whether an image shows a mask of an object; None if it need not, or if unclear.

    Much larger masks of other classes are of what it stands on: depths tell what stands before it.
    """
    pixels = _outline(points, view)
    local = se3.transform(se3.inverse(view.T_map_cam), points)
    limit = (view.camera.width - 1.0, view.camera.height - 1.0)
    inside = between(pixels, (0.0, 0.0), limit)
    if inside.mean() < _SHOWN or _is_hidden(pixels[inside], local[inside, 2], view):
        return None
    pixels = pixels[inside]
    size = float((np.ptp(pixels, axis=0) + 1.0).prod())
    share = doubtful = 0.0
    for name, mask in zip(view.detections.classes.tolist(), view.detections.masks, strict=True):
        held = float(holds(mask, pixels).mean())
        if name == label or (held > 0.0 and _overlap(mask, pixels) >= _ALIKE):
            share = max(share, held)
        elif mask.inside.size < _LARGER * size:
            doubtful = max(doubtful, held)
    if share >= _SEEN:
        return True
    return False if max(share, doubtful) <= _MISSED else None


def _outline(points: F64, view: View) -> F32:
    local = se3.transform(se3.inverse(view.T_map_cam), points)
    pixels: F32 = view.camera.project(local).astype(np.float32)
    return pixels


def _overlap(mask: Mask, pixels: F32) -> float:
    """Overlap of the box of a mask and that of pixels (n, 2), as a share of both."""
    h, w = mask.inside.shape
    low, high = pixels.min(axis=0), pixels.max(axis=0) + 1.0
    corner = np.array([mask.left, mask.top], np.float64)
    common = np.minimum(high, corner + np.array([w, h])) - np.maximum(low, corner)
    inner = float(np.maximum(common, 0.0).prod())
    return float(inner / (w * h + (high - low).prod() - inner))


def _is_hidden(pixels: F32, depth_m: F64, view: View) -> bool:
    """Whether most of what an image knows within an object's box lies before it."""
    low, high = pixels.min(axis=0), pixels.max(axis=0)
    within = ((view.surface_pixels >= low) & (view.surface_pixels <= high)).all(axis=1)
    if not within.any():
        return False
    return bool(np.mean(view.surface_m[within] < _NEARER * depth_m.min()) > 0.5)
