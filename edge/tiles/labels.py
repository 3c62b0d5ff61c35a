# SPDX-License-Identifier: Apache-2.0
"""What a segmentation model saw when the map was made: layers that a map may have or lack."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from edge.tiles.format import Array
from edge.tiles.reader import Map
from edge.tiles.tile import PORTRAIT_CELLS, Tile
from edge.types import F32, F64, I32, U8, Bools

_UNIT_TOLERANCE = 1e-3


class Portrait(NamedTuple):
    """What a camera saw of an object, on a square in the plane through its middle that faces it."""

    view: int  # which of the object's cameras
    right: F64  # (3,) unit vector of the map along the rows, across the line of sight
    side_m: float
    grey: U8  # (PORTRAIT_CELLS, PORTRAIT_CELLS), each cell the mean of what it covers


@dataclass(frozen=True, eq=False)
class MapObject:
    """One object as the map knows it."""

    label: int
    points: F64  # (n, 3) of the space that it takes, in the map [m]
    cameras: F64  # (v, 3) places of the images that must have shown it [m]
    found: Bools  # (v,) in which of them the model found it
    chance: F64 | None = None  # (v,) of each, that it does so again; None: as in `found`
    portraits: tuple[Portrait, ...] = ()

    @cached_property
    def center(self) -> F64:
        """Middle of its space (3,) [m]."""
        middle: F64 = self.points.mean(axis=0)
        return middle

    @cached_property
    def extent_m(self) -> F64:
        """Sides (3,) of its box along the map's axes [m]."""
        extent: F64 = np.ptp(self.points, axis=0)
        return extent

    @cached_property
    def view_directions(self) -> F64:
        """Unit vectors (v, 3) from its centre to `cameras`."""
        away = self.cameras - self.center
        directions: F64 = away / np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-9)
        return directions

    @cached_property
    def view_distance_m(self) -> float:
        """The largest distance from which it was found."""
        return float(np.linalg.norm(self.cameras[self.found] - self.center, axis=1).max())

    @property
    def hit_rate(self) -> float:
        """Share of the images that must have shown it in which it was found, and would be again."""
        return float(self.chances.mean())

    @property
    def chances(self) -> F64:
        """Of each of `cameras` (v,), that the model finds it from there."""
        return self.found.astype(np.float64) if self.chance is None else self.chance


class MapLabels:
    """The labels of a whole map. Read-only; any thread may ask."""

    def __init__(self, map_: Map) -> None:
        entry = map_.manifest.labels
        assert entry is not None
        self.names: tuple[str, ...] = tuple(entry.names)
        self._tiles = map_.tiles
        self._bases = np.cumsum([0, *(tile.entry.keyframes for tile in map_.tiles)])
        self._sequence = map_.keyframe_source[:, 0]
        self.objects: list[MapObject] = [thing for tile in map_.tiles for thing in _objects(tile)]
        # (P,) of each point of the map: its class, -1 for none.
        self.point_class: I32 = np.concatenate(
            [tile["labels/class"].astype(np.int32) for tile in map_.tiles]
        )
        for tile in map_.tiles:
            for name in ("labels/class", "labels/object_class", "labels/detection_class"):
                _check_classes(tile, name, len(self.names))

    def sure_points(self, share: float) -> Bools:
        """Which points (P,) have a class by at least this share of the images that see them."""
        agreeing = np.concatenate([tile["labels/agreeing"] for tile in self._tiles])
        seen = np.concatenate([tile["labels/seen"] for tile in self._tiles])
        sure: Bools = (self.point_class >= 0) & (agreeing >= share * seen)
        return sure

    @cached_property
    def looked_at(self) -> Bools:
        """Keyframes (K,) that the model was shown: maps with labels are joined with maps without.

        Where some points were in no image that it was shown, so was no recording in which it saw
        nothing at all.
        """
        if all(np.all(tile["labels/seen"]) for tile in self._tiles):
            return np.ones(len(self._sequence), bool)
        offsets = [tile["labels/detection_offsets"] for tile in self._tiles]
        saw = np.concatenate([row[1:] > row[:-1] for row in offsets])
        return np.isin(self._sequence, self._sequence[saw])

    def detections(self, k: int) -> tuple[F32, I32, F32]:
        """Boxes (n, 4) left, top, right, bottom [px], classes (n,) and scores (n,) of keyframe `k`.

        They are in the pixels of the image as it came, and weaker ones than objects are made of.
        """
        order = int(np.searchsorted(self._bases, k, side="right")) - 1
        tile = self._tiles[order]
        row = tile.row("labels/detection_offsets", k - int(self._bases[order]))
        boxes, scores = tile["labels/detection_box"][row], tile["labels/detection_score"][row]
        if not (np.isfinite(boxes).all() and np.isfinite(scores).all()):
            raise tile.damaged("labels/detection_box")
        return boxes, tile["labels/detection_class"][row].astype(np.int32), scores


def read_labels(map_: Map) -> MapLabels | None:
    """The labels of a map; None where it was made without a model."""
    entry = map_.manifest.labels
    if entry is None:
        return None
    for tile in map_.tiles:
        if "labels/class" not in tile.layers:
            raise tile.damaged("labels, which the manifest names,")
        tile.check()
        tile.release()
    return MapLabels(map_)


def object_layers(objects: Sequence[MapObject], origin: F64) -> dict[str, Array]:
    """The layers of a tile's objects."""
    none = np.empty((0, 3))
    return {
        "labels/object_class": np.array([thing.label for thing in objects], np.int16),
        "labels/object_place_offsets": _offsets([len(thing.points) for thing in objects]),
        "labels/object_place": _relative([none, *(thing.points for thing in objects)], origin),
        "labels/object_view_offsets": _offsets([len(thing.cameras) for thing in objects]),
        "labels/object_view": _relative([none, *(thing.cameras for thing in objects)], origin),
        "labels/object_found": np.concatenate(
            [np.empty(0, bool), *(thing.found for thing in objects)]
        ),
        **_portrait_layers(objects),
    }


def _portrait_layers(objects: Sequence[MapObject]) -> dict[str, Array]:
    taken = [portrait for thing in objects for portrait in thing.portraits]
    grey = [np.empty((0, PORTRAIT_CELLS, PORTRAIT_CELLS), np.uint8), *(p.grey[None] for p in taken)]
    return {
        "portraits/offsets": _offsets([len(thing.portraits) for thing in objects]),
        "portraits/view": np.array([p.view for p in taken], np.uint32),
        "portraits/right": np.array([p.right for p in taken], np.float32).reshape(-1, 3),
        "portraits/side": np.array([p.side_m for p in taken], np.float32),
        "portraits/grey": np.concatenate(grey),
    }


def _relative(parts: Sequence[F64], origin: F64) -> F32:
    relative: F32 = (np.concatenate(parts) - origin).astype(np.float32)
    return relative


def _offsets(counts: list[int]) -> Array:
    return np.concatenate([[0], np.cumsum(counts)]).astype(np.uint32)


def _objects(tile: Tile) -> list[MapObject]:
    """The objects of one tile, each checked."""
    origin = np.array(tile.entry.origin_m)
    found = []
    for i, label in enumerate(tile["labels/object_class"].tolist()):
        places = tile["labels/object_place"][tile.row("labels/object_place_offsets", i)]
        row = tile.row("labels/object_view_offsets", i)
        views = tile["labels/object_view"][row]
        seen = tile["labels/object_found"][row].view(np.uint8) != 0
        whole = len(places) and seen.any() and np.isfinite(places).all()
        if not (whole and np.isfinite(views).all() and np.abs(places).max() < 1e9):
            raise tile.damaged("labels/object_place")
        portraits = _portraits(tile, i, len(views))
        found.append(MapObject(label, places + origin, views + origin, seen, None, portraits))
    return found


def _portraits(tile: Tile, i: int, n_views: int) -> tuple[Portrait, ...]:
    """Those of a tile's object `i`, each checked; none in maps of older writers."""
    if "portraits/offsets" not in tile.layers:
        return ()
    row = tile.row("portraits/offsets", i)
    views, sides = tile["portraits/view"][row], tile["portraits/side"][row]
    right, grey = tile["portraits/right"][row].astype(np.float64), tile["portraits/grey"][row]
    unit = np.abs(np.linalg.norm(right, axis=1) - 1.0) < _UNIT_TOLERANCE
    if not (unit.all() and ((sides > 0.0) & (sides < 1e9)).all() and (views < n_views).all()):
        raise tile.damaged("portraits")
    columns = zip(views.tolist(), right, sides.tolist(), grey, strict=True)
    return tuple(Portrait(view, r, side_m, cells.copy()) for view, r, side_m, cells in columns)


def _check_classes(tile: Tile, name: str, n_classes: int) -> None:
    stored = tile[name]
    if stored.size and not -1 <= stored.min() <= stored.max() < n_classes:
        raise tile.damaged(name)
