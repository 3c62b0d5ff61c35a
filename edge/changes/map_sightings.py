# SPDX-License-Identifier: Apache-2.0
"""What the model saw about an object in the map's images, box by box."""

from collections import Counter
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from edge.changes.cover import between
from edge.config.changes import PresenceConfig
from edge.geometry import se3
from edge.tiles.labels import MapLabels, MapObject
from edge.tiles.reader import Map
from edge.types import F32, F64, I32, Bools

ONE_PLACE_M = 1e-4  # between what two objects say of the place of one image
RENAMED = 0.4  # the boxes of an object and of a mask of another name overlap by so much
_LARGER, _OFTEN = 2.0, 0.2  # than its own box; of the images that found it
_FEW, _OFTEN_ONE = 3, 0.5  # images that show both, and a share of them
_ASKED = 20  # images, about, that found it
_NAMED_OFTEN = 10  # images that found it: else it may have more names


def keyframe_of(thing: MapObject, i: int, map_: Map) -> int | None:
    """The keyframe that is the `i`th image that must have shown an object; None if unknown."""
    apart = np.linalg.norm(map_.T_map_cam[:, :3, 3] - thing.cameras[i], axis=1)
    k = int(apart.argmin())
    return k if apart[k] <= ONE_PLACE_M else None


class _Boxes(NamedTuple):
    """What the model saw in an image of the map, beside an object."""

    pixels: F64  # (p, 2) the object's places
    low: F64  # (2,) the box around them
    high: F64
    boxes: F32  # (n, 4)
    classes: I32  # (n,)
    scores: F32  # (n,)

    @property
    def sizes(self) -> F32:
        """Of each box (n,) [px^2]."""
        sizes: F32 = np.prod(self.boxes[:, 2:] - self.boxes[:, :2], axis=1)
        return sizes

    @property
    def overlap(self) -> F64:
        """Of each box and that of the object, as a share of both (n,)."""
        sizes = self.sizes
        own = float(np.prod(self.high - self.low))
        common = np.minimum(self.boxes[:, 2:], self.high) - np.maximum(self.boxes[:, :2], self.low)
        inner = np.prod(np.maximum(common, 0.0), axis=1)
        share: F64 = inner / np.maximum(sizes + own - inner, 1e-9)
        return share


def _boxes_about(thing: MapObject, i: int, map_: Map, labels: MapLabels) -> _Boxes | None:
    """What the model saw in the `i`th image that must have shown an object; None if unknown."""
    k = keyframe_of(thing, i, map_)
    if k is None:
        return None
    camera = map_.cameras[int(map_.keyframe_camera[k])]
    pixels = camera.project(se3.transform(se3.inverse(map_.pose(k)), thing.points))
    if not np.isfinite(pixels).all():
        return None
    return _Boxes(pixels, pixels.min(axis=0), pixels.max(axis=0), *labels.detections(k))


class InMap(NamedTuple):
    """An object with what the boxes in the images that found it say of it."""

    thing: MapObject  # with how surely each would find it again, by its score
    box: I32  # (v,) number of the box of its mask in each image, -1 for none
    held: Bools  # (v, n) which of its places lay in that

    def shares_masks(self, other: "InMap") -> bool:
        """Whether images took both for one: two things have masks of their own where both are."""
        apart = np.linalg.norm(self.thing.cameras[:, None] - other.thing.cameras, axis=2)
        here, there = np.nonzero(apart < ONE_PLACE_M)
        both = (self.box[here] >= 0) & (other.box[there] >= 0)
        same = self.box[here[both]] == other.box[there[both]]
        return len(same) < _FEW or bool(same.mean() > _OFTEN_ONE)


def told_by_images(thing: MapObject, map_: Map, labels: MapLabels, config: PresenceConfig) -> InMap:
    """What the boxes in the images that found an object say of it."""
    chance = thing.found.astype(np.float64)
    box: I32 = np.full(len(thing.found), -1, np.int32)
    held = np.zeros((len(thing.found), len(thing.points)), bool)
    for i in np.flatnonzero(thing.found).tolist():
        seen = _boxes_about(thing, i, map_, labels)
        if seen is None:
            continue
        middle = 0.5 * (seen.low + seen.high)
        over = ((seen.boxes[:, :2] <= middle) & (middle <= seen.boxes[:, 2:])).all(axis=1)
        own = (over & (seen.classes == thing.label)) | (seen.overlap > RENAMED)
        if own.any():
            best = box[i] = int(np.where(own, seen.scores, -1.0).argmax())
            span = max(config.sure_score - config.guessed_score, 1e-6)
            surely = (float(seen.scores[best]) - config.guessed_score) / span
            chance[i] = float(np.clip(surely, 0.0, 1.0))
            held[i] = between(seen.pixels, seen.boxes[best, :2], seen.boxes[best, 2:])
    return InMap(replace(thing, chance=chance), box, held)


def other_names(
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
        sizes, own = seen.sizes, np.prod(seen.high - seen.low)
        middle = 0.5 * (seen.low + seen.high)
        over = ((boxes[:, :2] <= middle) & (middle <= boxes[:, 2:])).all(axis=1)
        held.update(set(classes[over & (sizes > _LARGER * own)].tolist()))
        taken_for |= set(classes[seen.overlap > RENAMED].tolist())
        asked += 1
    often = {label for label, n in held.items() if n >= _OFTEN * asked} - {thing.label}
    return frozenset(often), frozenset(taken_for) if asked >= _NAMED_OFTEN else None
