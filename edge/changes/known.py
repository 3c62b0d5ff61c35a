# SPDX-License-Identifier: Apache-2.0
"""The objects of a map with what was seen of them."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from edge.changes.carving import Carving
from edge.changes.map_sightings import (
    ONE_PLACE_M,
    InMap,
    keyframe_of,
    other_names,
    told_by_images,
)
from edge.changes.parting import parted
from edge.changes.presence import Presence
from edge.changes.proof import CONFIRMED, CONTRADICTED
from edge.changes.seen_points import seen_points
from edge.config.changes import ChangesConfig
from edge.tiles.labels import MapLabels, MapObject
from edge.tiles.reader import Map
from edge.types import F64, I32, Bools, Evidence

_TEXTURED = 5  # points on it, from which on these must have gone, too
_AGAIN = 2  # once may be chance
_MOST_POINTS = 60  # that are asked for of one thing
_TESTED = 3  # of them, that images could confirm or contradict
_SURE_SHARE = 0.8  # of the images that see a point, whose masks hold it
_COMMON, _LARGEST_WHOLE = 0.5, 15.0  # of the smaller one's space; times it
_ASKED = 20  # images, about, that found it
_PART, _BESIDE_M = 15.0, 0.02  # times smaller, and so near a like thing: masks cut that in two
_FOUND = 0.9  # of the images that must have shown it
_BLINKING = 0.7  # what is found in fewer of them may not be found at all in another light
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
        self._forget_outline()
        self.evidence: list[Evidence] = []
        self.was_told = False
        self.is_part = False  # of another object, that tells for it
        # As of `InMap`.
        self.held: Bools = np.zeros((len(thing.found), len(thing.points)), bool)
        # How often images that missed it showed its points, and something else in their place.
        self._shown: Counter[int] = Counter()
        self._gone: Counter[int] = Counter()

    def _forget_outline(self) -> None:
        n = len(self.expected.points)
        # The second one from directions as those of the map's images that found it.
        self.carving, self.carving_alike = Carving(n), Carving(n)
        self.evidence_alike: list[Evidence] = []  # images of the second one, without masks

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

        Points must speak where the model often failed to find it. Where images hardly test points
        of it, the model must be twice as sure if it has texture, was seen meanwhile, or is unclear
        from as many viewpoints as it was missed from: then something plain may hide it from
        elsewhere.
        """
        same = sum(n >= max(_AGAIN, self._gone[p]) for p, n in self._shown.items())
        other = sum(n > self._shown[p] for p, n in self._gone.items())
        # Points that all show something else speak, too.
        again = sum(n for n in self._gone.values() if n >= _AGAIN)
        if self.is_carved_away and same == 0:
            return True
        if self._blinks and (same > 0 or other < _TESTED):
            return False
        is_sure = self.presence.is_nearly_gone and same == 0 and again >= _AGAIN * _TEXTURED
        if self.is_part or not (self.presence.is_gone or is_sure):
            return False
        # Points say nothing where there are hardly any, or all were seen from other sides.
        if len(self.points) < _TEXTURED or not (self._shown or self._gone):
            n_for = self.presence.n_for
            is_clear = n_for == 0 and self._is_rather_missed
            return is_clear or self.presence.is_gone_times(3 if n_for >= _AGAIN else 2)
        if same + other < _TESTED:
            return same == 0 and (other >= _AGAIN or self.presence.is_gone_twice)
        surely = self.presence.is_gone_twice and self.presence.n_for == 0
        return other >= 2 and other > (same if surely else 2 * same)

    @property
    def _blinks(self) -> bool:
        """Whether the model often failed to find it, and now and then under other masks, too."""
        return float(self.thing.found.mean()) < _BLINKING and self.expected.hit_rate < _FOUND

    @property
    def is_carved_away(self) -> bool:
        """Whether masks of its kind about it leave most of it bare, where they used to hold it."""
        carving = self.carving
        found = self.thing.hit_rate >= _FOUND and not self.is_part
        return found and carving.n_viewpoints >= _CARVED_FROM and carving.bare_share >= _BARE

    @property
    def lost_part(self) -> Bools | None:
        """Which of its places (n,) are of a part that is gone, while the rest is there."""
        if self.thing.hit_rate < _FOUND or self.is_part:
            return None
        return parted(self.expected.points, self.carving_alike)

    def keep(self, rest: Bools) -> None:
        """Be no more than the rest, of its places (n,); what its outline showed is forgotten."""
        self.thing = replace(self.thing, points=self.thing.points[rest], portraits=())
        self.expected = replace(self.expected, points=self.expected.points[rest])
        self.held = self.held[:, rest]
        self._forget_outline()

    def held_from(self, direction: F64, alike_deg: float) -> Bools | None:
        """Which of its places (n,) a mask held in the map's image from about there.

        `direction` (3,) is a unit vector from its middle to the camera. None if no image that
        found it was taken from a direction so near.
        """
        cosines = np.where(self.thing.found, self.thing.view_directions @ direction, -1.0)
        nearest = int(cosines.argmax())
        return self.held[nearest] if cosines[nearest] > np.cos(np.radians(alike_deg)) else None

    @property
    def _is_rather_missed(self) -> bool:
        return self.presence.n_against > self.presence.n_unclear


def known_objects(map_: Map, labels: MapLabels, config: ChangesConfig) -> list[Known]:
    """The objects of a map with the points that are on them."""
    # Some images put points beside a thing under its mask; those that are on it, nearly all do.
    labelled = np.flatnonzero(labels.sure_points(_SURE_SHARE)).astype(np.int32)
    xyz = map_.points(labelled).xyz
    found = []
    told = [told_by_images(thing, map_, labels, config.presence) for thing in labels.objects]
    things = [each.thing for each in told]
    for (thing, _, held), twins in zip(told, _twins(told), strict=True):
        reach = _NEAR_SHARE * float(np.linalg.norm(thing.extent_m)) + 0.01
        near = np.linalg.norm(xyz - thing.center, axis=1) < np.linalg.norm(thing.extent_m)
        near &= labels.point_class[labelled] == thing.label
        apart = np.linalg.norm(xyz[near][:, None] - thing.points[None], axis=2)
        on = apart.min(axis=1) < reach if near.any() else np.empty(0, bool)
        names = other_names(thing, map_, labels)
        points = labelled[near][on]
        if thing.hit_rate < config.presence.lowest_hit_rate:
            points = _points_in(thing, map_, reach)  # masks missed it too often to tell
        found.append(Known(thing, points, config, twins, *names))
        found[-1].is_part = any(is_part_of(thing, other) for other in things)
        found[-1].held = held
    return found


def _points_in(thing: MapObject, map_: Map, reach_m: float) -> I32:
    """Points of the map in the space of an object, that images see which found it."""
    found = np.flatnonzero(thing.found)
    inside: set[int] = set()
    for i in found[:: max(1, len(found) // _ASKED)].tolist():
        k = keyframe_of(thing, i, map_)
        if k is None:
            continue
        features, xyz = seen_points(map_, k)
        near = np.linalg.norm(xyz - thing.center, axis=1) < np.linalg.norm(thing.extent_m)
        if near.any():
            apart = np.linalg.norm(xyz[near][:, None] - thing.points[None], axis=2)
            inside |= set(features.point[near][apart.min(axis=1) < reach_m].tolist())
    points = np.array(sorted(inside), np.int32)
    return points[:: -(-len(points) // _MOST_POINTS) or 1]


def is_part_of(thing: MapObject, other: MapObject) -> bool:
    """Whether an object is a piece of another of its kind, that was cut off in some images."""
    if thing.label != other.label or thing.extent_m.prod() * _PART > other.extent_m.prod():
        return False
    reach = 0.5 * (other.extent_m + thing.extent_m) + _BESIDE_M
    return bool((np.abs(thing.center - other.center) < reach).all())


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


def _twins(told: Sequence[InMap]) -> list[list[MapObject]]:
    """Of each object the others of its kind that share its place: one thing, under two masks."""
    things = [each.thing for each in told]
    labels = np.array([thing.label for thing in things])
    centers = np.array([thing.center for thing in things]).reshape(-1, 3)
    halves = 0.5 * np.array([thing.extent_m for thing in things]).reshape(-1, 3)
    twins = []
    for i, thing in enumerate(things):
        shared = (np.abs(centers - centers[i]) < halves + halves[i]).all(axis=1)
        alike = np.flatnonzero(shared & (labels == thing.label))
        others = (j for j in alike.tolist() if j != i and told[i].shares_masks(told[j]))
        twins.append([things[j] for j in others])
    return twins


def _under_any_mask(thing: MapObject, twins: Sequence[MapObject]) -> MapObject:
    """The object as found by each image that found it or a twin.

    Else what the model takes now for this and now for that would seem rarely found.
    """
    found, chance = thing.found.copy(), thing.chances.copy()
    for twin in twins:
        apart = np.linalg.norm(thing.cameras[:, None] - twin.cameras[twin.found], axis=2)
        same = apart < ONE_PLACE_M
        found |= same.any(axis=1)
        chance = np.maximum(chance, (same * twin.chances[twin.found]).max(axis=1, initial=0.0))
    return replace(thing, found=found, chance=chance)
