# SPDX-License-Identifier: Apache-2.0
"""Everything that a program does with a map that it was given, whatever is in it."""

from pathlib import Path

import numpy as np

from edge.errors import TileError
from edge.tiles.index import BowVector
from edge.tiles.labels import read_labels
from edge.tiles.reader import Map, open_map

MAX_KEYFRAMES = 12  # looked at
_WORDS = BowVector(
    np.arange(0, 4000, 7, dtype=np.int32), np.full(572, 1.0 / 572.0, dtype=np.float32)
)


def read_everything(folder: Path) -> bool:
    """Open a map and use all of it; whether it could be used. Anything but TileError is a bug."""
    try:
        opened = open_map(folder)
    except TileError as error:
        check_words(error, folder)
        return False
    good = _tried(lambda: _scores(opened), folder)
    for k in range(min(opened.n_keyframes, MAX_KEYFRAMES)):
        good &= _tried(lambda k=k: _keyframe(opened, k), folder)
    good &= _tried(lambda: _points(opened), folder)
    good &= _tried(lambda: _labels(opened), folder)
    return good


def check_words(error: TileError, folder: Path) -> None:
    """An error says in one line which file, and more than that."""
    text = str(error)
    assert str(folder) in text, f"names no file: {text!r}"
    assert "\n" not in text, f"more than one line: {text!r}"
    assert len(text) < 4 * len(str(folder)) + 1000, f"too long: {len(text)} letters"


def _tried(use, folder: Path) -> bool:  # type: ignore[no-untyped-def]
    try:
        use()
    except TileError as error:
        check_words(error, folder)
        return False
    return True


def _scores(opened: Map) -> None:
    ids, scores = opened.bow.query(_WORDS, 5)
    assert len(ids) == len(scores)
    assert np.all((ids >= 0) & (ids < opened.n_keyframes))


def _keyframe(opened: Map, k: int) -> None:
    features = opened.features(k)
    known = features.point[features.point >= 0]
    assert np.all(known < opened.n_points)
    opened.points(known)
    others, shared = opened.covisible(k)
    assert np.all((others >= 0) & (others < opened.n_keyframes))
    assert len(others) == len(shared)
    lines = opened.lines.seen_by(k)
    assert np.all((lines >= 0) & (lines < opened.lines.count))
    opened.lines.take(lines)
    samples = opened.depth_samples(k)
    assert len(samples.pixels) == len(samples.sigma)


def _labels(opened: Map) -> None:
    labels = read_labels(opened)
    if labels is None:
        return
    assert len(labels.point_class) == opened.n_points
    for k in range(min(opened.n_keyframes, MAX_KEYFRAMES)):
        boxes, classes, scores = labels.detections(k)
        assert len(boxes) == len(classes) == len(scores)
    for thing in labels.objects:
        assert thing.label < len(labels.names)
        assert np.isfinite(thing.center).all()
        assert thing.view_distance_m > 0.0


def _points(opened: Map) -> None:
    for index in range(0, opened.n_points, max(1, opened.n_points // 20)):
        keyframes, features = opened.point_views(index)
        assert np.all((keyframes >= 0) & (keyframes < opened.n_keyframes))
        assert len(keyframes) == len(features)
