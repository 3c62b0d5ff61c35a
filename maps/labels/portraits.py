# SPDX-License-Identifier: Apache-2.0
"""Takes portraits of the objects of a map: how they look in its images."""

from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from edge.changes.portrait import ALIKE_RATIO, sampled
from edge.geometry.camera import CameraModel
from edge.tiles.labels import MapObject, Portrait
from edge.tiles.tile import PORTRAIT_CELLS
from edge.types import F64, U8, Mat4

_MOST = 8  # of one object
_APART_DEG = 8.0  # views so near to one another look alike
_APART_RATIO = ALIKE_RATIO**0.7
_AROUND = 1.5  # times the object's own size: with its edge, and some of what is behind


def portray(
    objects: Sequence[MapObject],
    poses: Sequence[Mat4],
    cameras: Sequence[CameraModel],
    image_of: Callable[[int], U8 | None],
) -> list[MapObject]:
    """The objects with their portraits, from views of T_map_cam `poses` by `cameras`.

    `image_of` gives the raw grey image of a view, None where it cannot be read; it is asked once
    for each view that is needed, in order.
    """
    places = np.array([T[:3, 3] for T in poses]).reshape(-1, 3)
    wanted: dict[int, list[tuple[int, Portrait]]] = defaultdict(list)
    for number, thing in enumerate(objects):
        for view in _chosen(thing):
            v = int(np.linalg.norm(places - thing.cameras[view], axis=1).argmin())
            wanted[v].append((number, _blank(thing, view, poses[v])))
    taken: list[list[Portrait]] = [[] for _ in objects]
    for v in sorted(wanted):
        image = image_of(v)
        if image is None:
            continue
        for number, blank in wanted[v]:
            grey = sampled(objects[number], blank, image, cameras[v], poses[v])
            if grey is not None:
                picture = np.clip(np.rint(grey), 0, 255).astype(np.uint8)
                taken[number].append(blank._replace(grey=picture))
    return [
        replace(thing, portraits=tuple(portraits))
        for thing, portraits in zip(objects, taken, strict=True)
    ]


def _chosen(thing: MapObject) -> list[int]:
    """Views that found a thing, each the most unlike those before it."""
    found = np.flatnonzero(thing.found)
    directions = thing.view_directions[found]
    log_m = np.log(np.maximum(np.linalg.norm(thing.cameras[found] - thing.center, axis=1), 1e-9))
    unlike = np.full(len(found), np.inf)
    chosen: list[int] = []
    best = int((directions @ directions.mean(axis=0)).argmax())
    while unlike[best] > 1.0 and len(chosen) < _MOST:
        chosen.append(int(found[best]))
        turned = np.degrees(np.arccos(np.clip(directions @ directions[best], -1.0, 1.0)))
        nearer = np.abs(log_m - log_m[best]) / np.log(_APART_RATIO)
        unlike = np.minimum(unlike, np.maximum(turned / _APART_DEG, nearer))
        best = int(unlike.argmax())
    return chosen


def _blank(thing: MapObject, view: int, T_map_cam: Mat4) -> Portrait:
    """A portrait still without a picture, upright in the image it is to be taken from."""
    towards = -thing.view_directions[view]
    right: F64 = T_map_cam[:3, 0] - (T_map_cam[:3, 0] @ towards) * towards
    right /= np.linalg.norm(right)
    flat = (thing.points - thing.center) @ np.stack([right, np.cross(towards, right)]).T
    side_m = _AROUND * 2.0 * float(np.abs(flat).max())
    none = np.zeros((PORTRAIT_CELLS, PORTRAIT_CELLS), np.uint8)
    return Portrait(view, right, max(side_m, 1e-3), none)
