# SPDX-License-Identifier: Apache-2.0
"""What a segmentation model said about a map, as the compiler holds it, and as tiles do."""

from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from edge.tiles.format import Array
from edge.tiles.labels import MapObject, object_layers, read_labels
from edge.tiles.manifest import LabelsEntry
from edge.tiles.reader import Map
from edge.types import F32, I32
from maps.extra import Sizes
from maps.labels.votes import PointLabels

if TYPE_CHECKING:
    from maps.layers import TileContent

I64 = NDArray[np.int64]


class Seen(NamedTuple):
    """What the model saw in one keyframe, weak things as well."""

    boxes: F32  # (n, 4) in the pixels of the image as it came
    classes: I32  # (n,)
    scores: F32  # (n,)


class LabelSet(NamedTuple):
    """The labels of a whole map."""

    entry: LabelsEntry
    points: PointLabels
    seen: list[Seen]  # of each view
    objects: list[MapObject]

    @classmethod
    def load(cls, opened: Map, keyframes: I32) -> "LabelSet | None":
        """The labels of a map, in its order of objects."""
        entry, read = opened.manifest.labels, read_labels(opened)
        if entry is None or read is None:
            return None
        tiles = opened.tiles
        votes = PointLabels(
            read.point_class,
            np.concatenate([tile["labels/agreeing"] for tile in tiles]).astype(np.int32),
            np.concatenate([tile["labels/seen"] for tile in tiles]).astype(np.int32),
            np.concatenate([tile["labels/log_odds"] for tile in tiles]),
        )
        return cls(entry, votes, [Seen(*read.detections(int(k))) for k in keyframes], read.objects)

    @classmethod
    def joined(
        cls, first: "LabelSet | None", second: "LabelSet | None", sizes: tuple[Sizes, Sizes]
    ) -> "LabelSet":
        """Labels of both, classes by their names.

        An object that both know stays in both forms: each tells how it looks from its own images.
        """
        some = first or second
        assert some is not None
        a = first or cls._nothing(some.entry, sizes[0])
        b = second or cls._nothing(some.entry, sizes[1])
        names = [*a.entry.names, *(name for name in b.entry.names if name not in a.entry.names)]
        number = np.array([*(names.index(name) for name in b.entry.names), -1], np.int32)
        votes = b.points._replace(label=number[b.points.label])
        return cls(
            msgspec.structs.replace(a.entry, names=names),
            PointLabels(*(np.concatenate(pair) for pair in zip(a.points, votes, strict=True))),
            [*a.seen, *(one._replace(classes=number[one.classes]) for one in b.seen)],
            [
                *a.objects,
                *(replace(thing, label=int(number[thing.label])) for thing in b.objects),
            ],
        )

    def kept(self, view: I32, point: I32) -> "LabelSet":
        """What is left with some views and points; all objects stay known."""
        columns: list[Any] = [array[point >= 0] for array in self.points]
        votes = PointLabels(*columns)
        seen = [seen for seen, number in zip(self.seen, view, strict=True) if number >= 0]
        return self._replace(points=votes, seen=seen)

    def arrays(self, content: "TileContent") -> dict[str, Array]:
        """The arrays of one tile."""
        said, points = self.points, content.points
        seen = [self.seen[k] for k in content.keyframes]
        offsets = np.concatenate([[0], np.cumsum([len(one.scores) for one in seen])])
        return {
            "labels/class": said.label[points].astype(np.int16),
            "labels/agreeing": np.minimum(said.agreeing[points], 65535).astype(np.uint16),
            "labels/seen": np.minimum(said.seen[points], 65535).astype(np.uint16),
            "labels/log_odds": said.log_odds[points].astype(np.float32),
            "labels/detection_offsets": offsets.astype(np.uint32),
            "labels/detection_box": np.concatenate([one.boxes for one in seen]),
            "labels/detection_class": np.concatenate([s.classes for s in seen]).astype(np.int16),
            "labels/detection_score": np.concatenate([one.scores for one in seen]),
            **object_layers(self._objects_of(content), content.origin),
        }

    def _objects_of(self, content: "TileContent") -> list[MapObject]:
        """The objects of a tile: it holds the keyframe next to the first that found them."""
        centres = np.array([view.T_map_cam[:3, 3] for view in content.views])
        chosen = []
        for thing in self.objects:
            first = thing.cameras[np.argmax(thing.found)]
            nearest = int(np.argmin(np.linalg.norm(centres - first, axis=1)))
            if content.keyframe_places.tile[nearest] == content.number:
                chosen.append(thing)
        return chosen

    @classmethod
    def _nothing(cls, entry: LabelsEntry, size: Sizes) -> "LabelSet":
        none = np.zeros(size.points, np.int32)
        votes = PointLabels(none - 1, none, none, np.zeros(size.points, np.float32))
        empty = Seen(np.empty((0, 4), np.float32), np.empty(0, np.int32), np.empty(0, np.float32))
        return cls(entry, votes, [empty] * size.views, [])
