# SPDX-License-Identifier: Apache-2.0
"""Reads every byte of a map: hashes, structure, and every reference from layer to layer."""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from edge.errors import TileError
from edge.relocalise.bow import vocabulary_of
from edge.tiles.labels import read_labels
from edge.tiles.learned import LearnedMap
from edge.tiles.reader import NO_POINT, Map, open_map


class Checked(NamedTuple):
    """What was found in order."""

    tiles: int
    bytes: int
    keyframes: int
    points: int


def verify(folder: Path) -> Checked:
    """Check a map; TileError names the first thing that is wrong."""
    opened = open_map(folder, verify=True)
    _check(opened)
    if opened.manifest.learned is not None:
        _check(LearnedMap(opened))
    if (labels := read_labels(opened)) is not None:
        for k in range(opened.n_keyframes):
            labels.detections(k)
    return Checked(
        len(opened.tiles),
        sum(entry.bytes for entry in opened.manifest.files()),
        opened.n_keyframes,
        opened.n_points,
    )


def _check(opened: Map) -> None:
    vocabulary_of(opened)
    views = sum(_check_keyframe(opened, k) for k in range(opened.n_keyframes))
    if views != opened.manifest.counts.observations:
        raise TileError(f"{opened.folder}: observations and features disagree; build the map again")
    _check_points(opened)


def _check_keyframe(opened: Map, k: int) -> int:
    """How many features of keyframe `k` are observations of points."""
    features = opened.features(k)
    points = features.point[features.point != NO_POINT]
    opened.points(points)
    others, _ = opened.covisible(k)
    if np.any(others == k):
        raise TileError(f"{opened.folder}: keyframe {k} is covisible with itself")
    opened.depth_samples(k)
    opened.lines.take(opened.lines.seen_by(k))
    return len(points)


def _check_points(opened: Map) -> None:
    """Every observation of a point is a feature that says so."""
    features = [opened.features(k).point for k in range(opened.n_keyframes)]
    for index in range(opened.n_points):
        for keyframe, feature in zip(*opened.point_views(index), strict=True):
            if feature >= len(features[keyframe]) or features[keyframe][feature] != index:
                raise TileError(
                    f"{opened.folder}: point {index} and keyframe {keyframe} disagree; "
                    "build the map again"
                )
