# SPDX-License-Identifier: Apache-2.0
"""The objects of a map with what was seen of them."""

import numpy as np

from edge.changes.presence import Presence
from edge.config.changes import ChangesConfig
from edge.tiles.labels import MapLabels, MapObject
from edge.tiles.reader import Map
from edge.types import I32, Evidence

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
