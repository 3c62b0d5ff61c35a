# SPDX-License-Identifier: Apache-2.0
"""Whether an object was hidden in the map's own images from about here: then it may be again.

The map knows few points of plain things, as the top of a table: from its images alone it is known
that something stands before an object.
"""

import numpy as np

from edge.changes.cover import between
from edge.changes.expect import expect
from edge.changes.known import Known
from edge.config.changes import PresenceConfig
from edge.tiles.labels import MapObject
from edge.tiles.reader import Map
from edge.types import F64, Bools

_NEAREST = 3  # images of the map
_ONE_PLACE_M = 1e-4  # between what an object and the map say of the place of one image


class MapViews:
    """The map's images that an object would be in. Owned by one thread."""

    def __init__(self, known: Known, map_: Map, looked_at: Bools, config: PresenceConfig) -> None:
        """`looked_at` (K,) are the keyframes that a model has seen."""
        self._thing, self._map, self._config = known.expected, map_, config
        # What found the same thing under another mask, showed it.
        found = (twin.cameras[twin.found] for twin in known.twins)
        self._shown_from: F64 = np.concatenate((self._thing.cameras, *found))
        self._facing = np.flatnonzero(looked_at & _are_facing(self._thing, map_))
        self._places: F64 = map_.T_map_cam[self._facing, :3, 3]
        self._showed: dict[int, bool | None] = {}

    def was_hidden_from(self, origin: F64) -> bool:
        """Whether the nearest images that would show it, were nothing before it, did not."""
        answers: list[bool] = []
        for i in np.argsort(np.linalg.norm(self._places - origin, axis=1), kind="stable").tolist():
            if (showed := self._did_show(i)) is not None:
                answers.append(showed)
            if len(answers) == _NEAREST:
                break
        return bool(answers) and not any(answers)

    def _did_show(self, i: int) -> bool | None:
        """Whether the `i`th image must have shown it; None where that is not for a thing before."""
        if i not in self._showed:
            k = int(self._facing[i])
            camera = self._map.cameras[int(self._map.keyframe_camera[k])]
            free = expect(self._thing, self._map.pose(k), camera, _nothing_before, self._config)
            apart = np.linalg.norm(self._shown_from - self._places[i], axis=1)
            must = bool((apart < _ONE_PLACE_M).any())
            self._showed[i] = must if must or free.holds else None
        return self._showed[i]


def _are_facing(thing: MapObject, map_: Map) -> Bools:
    """Keyframes (K,) whose images hold the middle of a thing."""
    places = map_.T_map_cam[:, :3, 3]
    local = np.einsum("kji,kj->ki", map_.T_map_cam[:, :3, :3], thing.center - places)
    inside: Bools = local[:, 2] > 0.0
    for number, camera in enumerate(map_.cameras):
        own = inside & (map_.keyframe_camera == number)
        inside[own] = between(
            camera.project(local[own]), (0.0, 0.0), (camera.width - 1.0, camera.height - 1.0)
        )
    return inside


def _nothing_before(pixels: F64, _depth_m: F64) -> F64:
    return np.full(len(pixels), np.nan)
