# SPDX-License-Identifier: Apache-2.0
"""A painted wall as a labelled map: a ball before it that a model found in all images."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from edge.tiles.labels import MapObject
from edge.tiles.manifest import LabelsEntry
from edge.tiles.reader import Map, open_map
from edge.types import U8, Mat4
from maps.build import BuildInput, build
from maps.content import load, write
from maps.labels.layer import LabelSet, Seen
from maps.labels.votes import PointLabels
from maps.settings import BuildSettings
from tests.edge.changes.scenes import ball_detection
from tests.maps.wall_drive import CAMERA, picture, wall, write_wall_drive

Ball = tuple[int, NDArray[np.float64], float]
NAMES = ["cup", "person", "book"]
CUP: Ball = (0, np.array([0.05, 0.1, 1.5]), 0.1)
N_VIEWS = 8
PAINT = wall()


def labels(map_: Map, balls: list[Ball]) -> LabelSet:
    """What a model would have said of the map's images."""
    content = load(map_)
    n = len(content.points.xyz)
    none = np.zeros(n, np.int32)
    votes = PointLabels(none - 1, none, none, np.zeros(n, np.float32))
    views = [view.T_map_cam for view in content.views]
    found = [ball_detection(balls, T, CAMERA) for T in views]
    rng = np.random.default_rng(0)
    objects = []
    for label, center, radius in balls:
        inside = rng.normal(size=(60, 3))
        inside *= radius * rng.random((60, 1)) ** (1 / 3) / np.linalg.norm(inside, axis=1)[:, None]
        cameras = np.stack([T[:3, 3] for T in views])
        objects.append(MapObject(label, center + inside, cameras, np.ones(len(views), bool)))
    entry = LabelsEntry(model="exact.onnx", sha256="0" * 64, names=NAMES)
    return LabelSet(entry, votes, [Seen(d.boxes, d.classes, d.scores) for d in found], objects)


def make_labelled(folder: Path) -> Map:
    """The map, with CUP in it."""
    drive = write_wall_drive(folder / "wall", N_VIEWS)
    build(BuildInput([drive]), folder / "plain", BuildSettings(lens="given"))
    plain = open_map(folder / "plain")
    content = load(plain)._replace(extra={"labels": labels(plain, [CUP])})
    write(content, plain.manifest, folder / "labelled")
    return open_map(folder / "labelled")


def shown(T: Mat4, balls: list[Ball]) -> U8:
    """The wall with grey balls before it."""
    image = picture(PAINT, T)
    for mask in ball_detection(balls, T, CAMERA).masks:
        h, w = mask.inside.shape
        image[mask.top : mask.top + h, mask.left : mask.left + w][mask.inside] = 120
    return image
