# SPDX-License-Identifier: Apache-2.0
"""The objects of a map with what was seen of them."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from edge.changes.carving import Carving
from edge.changes.presence import Presence
from edge.changes.proof import CONFIRMED, CONTRADICTED
from edge.changes.seen_points import seen_points
from edge.config.changes import ChangesConfig, PresenceConfig
from edge.geometry import se3
from edge.tiles.labels import MapLabels, MapObject
from edge.tiles.reader import Map
from edge.types import F32, F64, I32, Evidence

_TEXTURED = 5  # points on it, from which on these must have gone, too
_AGAIN = 2  # once may be chance
_MOST_POINTS = 60  # that are asked for of one thing
_TESTED = 3  # of them, that images could confirm or contradict
_SURE_SHARE = 0.8  # of the images that see a point, whose masks hold it
_ONE_PLACE_M = 1e-4  # between what two objects say of the place of one image
_LARGER, _OFTEN = 2.0, 0.2  # than its own box; of the images that found it
_COMMON, _LARGEST_WHOLE = 0.5, 15.0  # of the smaller one's space; times it
_ASKED = 20  # images, about, that found it
_NAMED_OFTEN = 10  # images that found it: else it may have more names
RENAMED = 0.4  # the boxes of an object and of a mask of another name overlap by so much
_PART, _BESIDE_M = 15.0, 0.02  # times smaller, and so near a like thing: masks cut that in two
_FOUND = 0.9  # of the images that must have shown it
_CARVED_FROM, _BARE = 10, 0.6  # viewpoints; of its points, of which more see them bare than held
_NEAR_SHARE = 0.05  # of an object's extent; points of the map so near are of the object


class Known:
    """One object of the map and what was seen of it."""

    def __init__(
        self,
        thing: MapObject,
        points: I32,
        config: ChangesConfig,
        twins: Sequence[MapObject] = (),
        company: frozenset[int] = frozenset(),
        aliases: frozenset[int] | None = None,
    ) -> None:
        """`points` of the map are on it; `twins` are the same thing under other masks.

        `company` are the classes whose masks held it in the map's images, `aliases` those that
        it was taken for; None where too few images tell.
        """
        self.thing = thing
        self.points = points
        self.twins = tuple(twins)
        self.company = company
        self.aliases = aliases
        self.expected = _under_any_mask(thing, twins)
        self.presence = Presence(config.presence)
        self.carving = Carving(len(self.expected.points))
        self.evidence: list[Evidence] = []
        self.was_told = False
        self.is_part = False  # of another object, that tells for it
        # How often images that missed it showed its points, and something else in their place.
        self._shown: Counter[int] = Counter()
        self._gone: Counter[int] = Counter()

    @property
    def usual(self) -> MapObject:
        """The thing as the map's images found it most surely."""
        return max((self.thing, *self.twins), key=lambda thing: thing.hit_rate)

    def hear_points(self, points: I32, verdict: I32) -> None:
        """Take what an image in which the model missed it says of its points."""
        self._shown.update(points[verdict == CONFIRMED].tolist())
        self._gone.update(points[verdict == CONTRADICTED].tolist())

    @property
    def is_gone(self) -> bool:
        """Whether model and points agree that it is not there.

        Where images hardly test points of it, the model must be twice as sure if it has texture,
        was seen meanwhile, or is unclear from as many viewpoints as it was missed from: then
        something plain may hide it from elsewhere.
        """
        same = sum(n >= max(_AGAIN, self._gone[p]) for p, n in self._shown.items())
        other = sum(n > self._shown[p] for p, n in self._gone.items())
        # Points that all show something else speak, too.
        again = sum(n for n in self._gone.values() if n >= _AGAIN)
        if self.is_carved_away and same == 0:
            return True
        is_sure = self.presence.is_nearly_gone and same == 0 and again >= _AGAIN * _TEXTURED
        if self.is_part or not (self.presence.is_gone or is_sure):
            return False
        # Points say nothing where there are hardly any, or all were seen from other sides.
        if len(self.points) < _TEXTURED or not (self._shown or self._gone):
            is_clear = self.presence.n_for == 0 and self._is_rather_missed
            return is_clear or self.presence.is_gone_twice
        if same + other < _TESTED:
            return same == 0 and (other >= _AGAIN or self.presence.is_gone_twice)
        surely = self.presence.is_gone_twice and self.presence.n_for == 0
        return other >= 2 and other > (same if surely else 2 * same)

    @property
    def is_carved_away(self) -> bool:
        """Whether masks of its kind about it leave most of it bare, where they used to hold it."""
        carving = self.carving
        found = self.thing.hit_rate >= _FOUND and not self.is_part
        return found and carving.n_viewpoints >= _CARVED_FROM and carving.bare_share >= _BARE

    @property
    def _is_rather_missed(self) -> bool:
        return self.presence.n_against > self.presence.n_unclear


def known_objects(map_: Map, labels: MapLabels, config: ChangesConfig) -> list[Known]:
    """The objects of a map with the points that are on them."""
    # Some images put points beside a thing under its mask; those that are on it, nearly all do.
    labelled = np.flatnonzero(labels.sure_points(_SURE_SHARE)).astype(np.int32)
    xyz = map_.points(labelled).xyz
    found = []
    things = [_with_chances(thing, map_, labels, config.presence) for thing in labels.objects]
    for thing, twins in zip(things, _twins(things), strict=True):
        reach = _NEAR_SHARE * float(np.linalg.norm(thing.extent_m)) + 0.01
        near = np.linalg.norm(xyz - thing.center, axis=1) < np.linalg.norm(thing.extent_m)
        near &= labels.point_class[labelled] == thing.label
        apart = np.linalg.norm(xyz[near][:, None] - thing.points[None], axis=2)
        on = apart.min(axis=1) < reach if near.any() else np.empty(0, bool)
        names = _other_names(thing, map_, labels)
        points = labelled[near][on]
        if thing.hit_rate < config.presence.lowest_hit_rate:
            points = _points_in(thing, map_, reach)  # masks missed it too often to tell
        found.append(Known(thing, points, config, twins, *names))
        found[-1].is_part = any(is_part_of(thing, other) for other in things)
    return found


def _points_in(thing: MapObject, map_: Map, reach_m: float) -> I32:
    """Points of the map in the space of an object, that images see which found it."""
    found = np.flatnonzero(thing.found)
    inside: set[int] = set()
    for i in found[:: max(1, len(found) // _ASKED)].tolist():
        k = _keyframe_of(thing, i, map_)
        if k is None:
            continue
        features, xyz = seen_points(map_, k)
        near = np.linalg.norm(xyz - thing.center, axis=1) < np.linalg.norm(thing.extent_m)
        if near.any():
            apart = np.linalg.norm(xyz[near][:, None] - thing.points[None], axis=2)
            inside |= set(features.point[near][apart.min(axis=1) < reach_m].tolist())
    points = np.array(sorted(inside), np.int32)
    return points[:: -(-len(points) // _MOST_POINTS) or 1]


def _keyframe_of(thing: MapObject, i: int, map_: Map) -> int | None:
    """The keyframe that is the `i`th image that must have shown an object; None if unknown."""
    apart = np.linalg.norm(map_.T_map_cam[:, :3, 3] - thing.cameras[i], axis=1)
    k = int(apart.argmin())
    return k if apart[k] <= _ONE_PLACE_M else None


def is_part_of(thing: MapObject, other: MapObject) -> bool:
    """Whether an object is a piece of another of its kind, that was cut off in some images."""
    if thing.label != other.label or thing.extent_m.prod() * _PART > other.extent_m.prod():
        return False
    reach = 0.5 * (other.extent_m + thing.extent_m) + _BESIDE_M
    return bool((np.abs(thing.center - other.center) < reach).all())


class _Boxes(NamedTuple):
    """What the model saw in an image of the map, beside an object."""

    low: F64  # (2,) the box around the object
    high: F64
    boxes: F32  # (n, 4)
    classes: I32  # (n,)
    scores: F32  # (n,)

    @property
    def overlap(self) -> F64:
        """Of each box and that of the object, as a share of both (n,)."""
        sizes = np.prod(self.boxes[:, 2:] - self.boxes[:, :2], axis=1)
        own = float(np.prod(self.high - self.low))
        common = np.minimum(self.boxes[:, 2:], self.high) - np.maximum(self.boxes[:, :2], self.low)
        inner = np.prod(np.maximum(common, 0.0), axis=1)
        share: F64 = inner / np.maximum(sizes + own - inner, 1e-9)
        return share


def _boxes_about(thing: MapObject, i: int, map_: Map, labels: MapLabels) -> _Boxes | None:
    """What the model saw in the `i`th image that must have shown an object; None if unknown."""
    k = _keyframe_of(thing, i, map_)
    if k is None:
        return None
    camera = map_.cameras[int(map_.keyframe_camera[k])]
    pixels = camera.project(se3.transform(se3.inverse(map_.pose(k)), thing.points))
    if not np.isfinite(pixels).all():
        return None
    return _Boxes(pixels.min(axis=0), pixels.max(axis=0), *labels.detections(k))


def _with_chances(
    thing: MapObject, map_: Map, labels: MapLabels, config: PresenceConfig
) -> MapObject:
    """The object with how surely each image that found it would find it again, by its score."""
    chance = thing.found.astype(np.float64)
    for i in np.flatnonzero(thing.found).tolist():
        seen = _boxes_about(thing, i, map_, labels)
        if seen is None:
            continue
        middle = 0.5 * (seen.low + seen.high)
        over = ((seen.boxes[:, :2] <= middle) & (middle <= seen.boxes[:, 2:])).all(axis=1)
        own = (over & (seen.classes == thing.label)) | (seen.overlap > RENAMED)
        if own.any():
            best = float(seen.scores[own].max())
            span = max(config.sure_score - config.guessed_score, 1e-6)
            chance[i] = float(np.clip((best - config.guessed_score) / span, 0.0, 1.0))
    return replace(thing, chance=chance)


def _other_names(
    thing: MapObject, map_: Map, labels: MapLabels
) -> tuple[frozenset[int], frozenset[int] | None]:
    """Classes of large masks that held it where it was found, and of those that were as large."""
    held: Counter[int] = Counter()
    taken_for: set[int] = set()
    asked = 0
    found = np.flatnonzero(thing.found)
    for i in found[:: max(1, len(found) // _ASKED)].tolist():
        seen = _boxes_about(thing, i, map_, labels)
        if seen is None:
            continue
        boxes, classes = seen.boxes, seen.classes
        sizes, own = (
            np.prod(boxes[:, 2:] - boxes[:, :2], axis=1),
            np.prod(seen.high - seen.low),
        )
        middle = 0.5 * (seen.low + seen.high)
        over = ((boxes[:, :2] <= middle) & (middle <= boxes[:, 2:])).all(axis=1)
        held.update(set(classes[over & (sizes > _LARGER * own)].tolist()))
        taken_for |= set(classes[seen.overlap > RENAMED].tolist())
        asked += 1
    often = {label for label, n in held.items() if n >= _OFTEN * asked} - {thing.label}
    return frozenset(often), frozenset(taken_for) if asked >= _NAMED_OFTEN else None


def shares_place(one: Known, other: Known) -> bool:
    """Whether two objects are one thing under two names, or a thing and a part of it."""
    a, b = one.thing, other.thing
    low = np.maximum(a.center - 0.5 * a.extent_m, b.center - 0.5 * b.extent_m)
    high = np.minimum(a.center + 0.5 * a.extent_m, b.center + 0.5 * b.extent_m)
    common = float(np.prod(np.maximum(high - low, 0.0)))
    small, large = sorted((float(np.prod(a.extent_m)), float(np.prod(b.extent_m))))
    # Space that masks carve does not quite agree: a mask of one held the other, too.
    is_part = a.label in other.company or b.label in one.company
    return common > (0.0 if is_part else _COMMON * small) and large < _LARGEST_WHOLE * small


def _twins(things: Sequence[MapObject]) -> list[list[MapObject]]:
    """Of each object the others of its kind that share its place: one thing, under two masks."""
    labels = np.array([thing.label for thing in things])
    centers = np.array([thing.center for thing in things]).reshape(-1, 3)
    halves = 0.5 * np.array([thing.extent_m for thing in things]).reshape(-1, 3)
    twins = []
    for i, thing in enumerate(things):
        shared = (np.abs(centers - centers[i]) < halves + halves[i]).all(axis=1)
        alike = np.flatnonzero(shared & (labels == thing.label))
        twins.append([things[j] for j in alike.tolist() if j != i])
    return twins


def _under_any_mask(thing: MapObject, twins: Sequence[MapObject]) -> MapObject:
    """The object as found by each image that found it or a twin.

    Else what the model takes now for this and now for that would seem rarely found.
    """
    found, chance = thing.found.copy(), thing.chances.copy()
    for twin in twins:
        apart = np.linalg.norm(thing.cameras[:, None] - twin.cameras[twin.found], axis=2)
        same = apart < _ONE_PLACE_M
        found |= same.any(axis=1)
        chance = np.maximum(chance, (same * twin.chances[twin.found]).max(axis=1, initial=0.0))
    return replace(thing, found=found, chance=chance)
