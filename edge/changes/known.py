# SPDX-License-Identifier: Apache-2.0
"""The objects of a map with what was seen of them."""

from collections import Counter

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
_NEAR_SHARE = 0.05  # of an object's extent; points of the map so near are of the object


class Known:
    """One object of the map and what was seen of it."""

    def __init__(self, thing: MapObject, points: I32, config: ChangesConfig) -> None:
        self.thing = thing
        self.points = points  # of the map, on it
        self.presence = Presence(config.presence)
        self.evidence: list[Evidence] = []
        self.was_told = False
        # How often images that missed it showed its points, and something else in their place.
        self._shown: Counter[int] = Counter()
        self._gone: Counter[int] = Counter()

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
    for thing in labels.objects:
        reach = _NEAR_SHARE * float(np.linalg.norm(thing.extent_m)) + 0.01
        near = np.linalg.norm(xyz - thing.center, axis=1) < np.linalg.norm(thing.extent_m)
        near &= labels.point_class[labelled] == thing.label
        apart = np.linalg.norm(xyz[near][:, None] - thing.points[None], axis=2)
        on = apart.min(axis=1) < reach if near.any() else np.empty(0, bool)
        found.append(Known(thing, labelled[near][on], config))
    return found
