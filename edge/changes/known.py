# SPDX-License-Identifier: Apache-2.0
"""The objects of a map with what was seen of them."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from edge.changes.presence import Presence
from edge.changes.proof import CONFIRMED, CONTRADICTED
from edge.config.changes import ChangesConfig
from edge.tiles.labels import MapLabels, MapObject
from edge.tiles.reader import Map
from edge.types import I32, Evidence

_TEXTURED = 5  # points on it, from which on these must have gone, too
_AGAIN = 2  # once may be chance
_TESTED = 3  # of them, that images could confirm or contradict
_SURE_SHARE = 0.8  # of the images that see a point, whose masks hold it
_ONE_PLACE_M = 1e-4  # between what two objects say of the place of one image
_NEAR_SHARE = 0.05  # of an object's extent; points of the map so near are of the object


class Known:
    """One object of the map and what was seen of it."""

    def __init__(
        self,
        thing: MapObject,
        points: I32,
        config: ChangesConfig,
        twins: Sequence[MapObject] = (),
    ) -> None:
        """`points` of the map are on it; `twins` are the same thing under other masks."""
        self.thing = thing
        self.points = points
        self.twins = tuple(twins)
        self.expected = _under_any_mask(thing, twins)
        self.presence = Presence(config.presence)
        self.evidence: list[Evidence] = []
        self.was_told = False
        # How often images that missed it showed its points, and something else in their place.
        self._shown: Counter[int] = Counter()
        self._gone: Counter[int] = Counter()

    @property
    def usual(self) -> MapObject:
        """The thing as the map's images found it most surely."""
        return max((self.thing, *self.twins), key=lambda thing: thing.hit_rate)

    def hear_points(self, points: I32, verdict: I32) -> None:
        """Take what an image in which the model missed it says of points of the map."""
        own = np.isin(points, self.points)
        self._shown.update(points[own & (verdict == CONFIRMED)].tolist())
        self._gone.update(points[own & (verdict == CONTRADICTED)].tolist())

    @property
    def is_gone(self) -> bool:
        """Whether model and points agree that it is not there.

        Where images hardly test points of it, the model must be twice as sure if it has texture,
        or was seen meanwhile: then something plain may hide it from elsewhere.
        """
        if not self.presence.is_gone:
            return False
        same = sum(n >= max(_AGAIN, self._gone[p]) for p, n in self._shown.items())
        other = sum(n > self._shown[p] for p, n in self._gone.items())
        if len(self.points) < _TEXTURED:
            return self.presence.n_for == 0 or self.presence.is_gone_twice
        if same + other < _TESTED:
            return same == 0 and self.presence.is_gone_twice
        surely = self.presence.is_gone_twice and self.presence.n_for == 0
        return other >= 2 and other > (same if surely else 2 * same)


def known_objects(map_: Map, labels: MapLabels, config: ChangesConfig) -> list[Known]:
    """The objects of a map with the points that are on them."""
    # Some images put points beside a thing under its mask; those that are on it, nearly all do.
    labelled = np.flatnonzero(labels.sure_points(_SURE_SHARE)).astype(np.int32)
    xyz = map_.points(labelled).xyz
    found = []
    for thing, twins in zip(labels.objects, _twins(labels.objects), strict=True):
        reach = _NEAR_SHARE * float(np.linalg.norm(thing.extent_m)) + 0.01
        near = np.linalg.norm(xyz - thing.center, axis=1) < np.linalg.norm(thing.extent_m)
        near &= labels.point_class[labelled] == thing.label
        apart = np.linalg.norm(xyz[near][:, None] - thing.points[None], axis=2)
        on = apart.min(axis=1) < reach if near.any() else np.empty(0, bool)
        found.append(Known(thing, labelled[near][on], config, twins))
    return found


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
    found = thing.found.copy()
    for twin in twins:
        apart = np.linalg.norm(thing.cameras[:, None] - twin.cameras[twin.found], axis=2)
        found |= (apart < _ONE_PLACE_M).any(axis=1)
    return replace(thing, found=found)
