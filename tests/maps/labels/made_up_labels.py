# SPDX-License-Identifier: Apache-2.0
"""Made-up labels of a map, for tests of what carries them."""

import numpy as np

from edge.tiles.labels import MapObject, Portrait
from edge.tiles.manifest import LabelsEntry
from edge.tiles.tile import PORTRAIT_CELLS
from maps.content import Content
from maps.labels.layer import LabelSet, Seen
from maps.labels.votes import PointLabels

NAMES = ["cup", "chair", "book"]


def _portrait(rng: np.random.Generator, view: int) -> Portrait:
    right = rng.normal(size=3)
    grey = rng.integers(0, 256, (PORTRAIT_CELLS, PORTRAIT_CELLS)).astype(np.uint8)
    return Portrait(view, right / np.linalg.norm(right), float(rng.uniform(0.1, 1.0)), grey)


def labels_for(content: Content, seed: int = 0, names: list[str] = NAMES) -> LabelSet:
    """Classes, boxes and objects at random, of the shape that `content` asks for."""
    rng = np.random.default_rng(seed)
    n = len(content.points.xyz)
    label = rng.integers(-1, len(names), n).astype(np.int32)
    agreeing = np.where(label >= 0, rng.integers(3, 9, n), 0).astype(np.int32)
    seen = []
    for _ in content.views:
        m = int(rng.integers(0, 4))
        boxes = rng.uniform(0.0, 100.0, (m, 4)).astype(np.float32)
        classes = rng.integers(0, len(names), m).astype(np.int32)
        seen.append(Seen(boxes, classes, rng.uniform(0.1, 1.0, m).astype(np.float32)))
    centres = [view.T_map_cam[:3, 3] for view in content.views]
    objects = [
        MapObject(
            int(rng.integers(0, len(names))),
            centres[k] + (0.0, 0.0, 2.0) + 0.1 * rng.normal(size=(20, 3)),
            np.stack(centres[k : k + 2]),
            np.array([True, bool(k % 2)]),
            portraits=tuple(_portrait(rng, view) for view in range(k % 3)),
        )
        for k in range(len(centres) - 1)
    ]
    entry = LabelsEntry(model="seen.onnx", sha256="0" * 64, names=names)
    log_odds = rng.normal(size=n).astype(np.float32)
    return LabelSet(entry, PointLabels(label, agreeing, agreeing + 1, log_odds), seen, objects)
