# SPDX-License-Identifier: Apache-2.0
"""Which class each point of a map belongs to, by the votes of all images that see it."""

import math
from typing import NamedTuple

import numpy as np

from edge.changes.cover import find_cover
from edge.types import F32, I32, Detections

MIN_AGREEING = 3  # frames, as in the method of 2021
_HIT = math.log(0.8 / 0.2)  # a mask of the class over a point of the class, or of another one
_MISS = math.log(0.4 / 0.9)  # no such mask: models miss more than they invent
_BOUND = 20.0  # log-odds; more is the same


class PointLabels(NamedTuple):
    """The labels of points."""

    label: I32  # (P,) class, -1 for none
    agreeing: I32  # (P,) images that voted for it
    seen: I32  # (P,) images that saw the point
    log_odds: F32  # (P,) of its being of that class; 0 for none


class LabelVotes:
    """Counts, for each point, the classes that cover it in the images that see it."""

    def __init__(self, n_points: int, n_classes: int) -> None:
        self._n_points, self._n_classes = n_points, n_classes
        self._ballots: list[np.ndarray] = []
        self._seen: I32 = np.zeros(n_points, dtype=np.int32)

    def add(self, points: I32, pixels: F32, detections: Detections) -> None:
        """Take the votes of one image.

        points  (n,)    int32    points that it sees, each once
        pixels  (n, 2)  float32  where, in the pixels of the image that was segmented
        """
        owner = find_cover(detections, pixels)
        covered = np.flatnonzero(owner >= 0)
        labels = detections.classes[owner[covered]].astype(np.int64)
        self._ballots.append(points[covered].astype(np.int64) * self._n_classes + labels)
        self._seen[points] += 1

    def count(self) -> PointLabels:
        """The class with most votes of each point, where enough images agree; ties to the lower."""
        label: I32 = np.full(self._n_points, -1, dtype=np.int32)
        agreeing: I32 = np.zeros(self._n_points, dtype=np.int32)
        ballots = np.concatenate([np.empty(0, dtype=np.int64), *self._ballots])
        keys, votes = np.unique(ballots, return_counts=True)
        order = np.lexsort((keys, -votes))
        points, first = np.unique(keys[order] // self._n_classes, return_index=True)
        best = order[first]
        enough = votes[best] >= MIN_AGREEING
        points, best = points[enough], best[enough]
        label[points] = (keys[best] % self._n_classes).astype(np.int32)
        agreeing[points] = votes[best].astype(np.int32)
        odds = np.clip(agreeing * _HIT + (self._seen - agreeing) * _MISS, -_BOUND, _BOUND)
        log_odds: F32 = np.where(label >= 0, odds, 0.0).astype(np.float32)
        return PointLabels(label, agreeing, self._seen.copy(), log_odds)
