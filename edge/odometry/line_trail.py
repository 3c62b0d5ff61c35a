# SPDX-License-Identifier: Apache-2.0
"""Edges followed over the last frames: as many frames as share enough with one among them."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edge.lines import kernels_associate
from edge.lines.line import Segments, ends
from edge.types import F64, I32, Bools, Frame

# Frames that are kept; every second one goes when there are more.
_MAX_FRAMES = 16
_MIN_SEGMENTS = 9  # that the first and the newest frame share with the one between
# Segments of neighbouring frames.
_REACH_PX, _COSINE, _MIN_SHARE = 8.0, float(np.cos(np.deg2rad(5.0))), 0.5


@dataclass(slots=True, eq=False)
class Sighting:
    """Where a frame shows what is followed."""

    number: int  # counted by the images that were given
    frame: Frame
    segments: F64  # (k, 4) ends, NaN where not seen


class LineTrail:
    """Owned by the tracking thread.

    In a turning camera's sight little stays for long, so the frame that all others are held
    against is one between them: it sees what has left since and what has come.
    """

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget all."""
        self.sightings: list[Sighting] = []
        self._given = 0
        self.reference = 0  # number of the sighting that shares most with all others

    @property
    def has_enough(self) -> bool:
        """Whether the newest frame shows enough to be followed."""
        return bool(self.sightings) and _count(self.sightings[-1].segments) >= _MIN_SEGMENTS

    def step(self, frame: Frame, found: Segments, max_age: int) -> None:
        """Follow into the next image's segments; forget what is more than so many images old."""
        self._given += 1
        at = ends(found)
        segments, free = np.empty((0, 4)), np.ones(len(at), bool)
        if self.sightings:
            segments, free = self._followed(found)
        for sighting in self.sightings:
            sighting.segments = _longer(sighting.segments, int(np.count_nonzero(free)))
        self.sightings.append(Sighting(self._given, frame, np.vstack((segments, at[free]))))
        while self._given - self.sightings[0].number > max_age:
            del self.sightings[0]
        self._let_go()

    def _let_go(self) -> None:
        """Drop first frames until one shares enough with all, and what no frame shows any more."""
        if len(self.sightings) > _MAX_FRAMES:
            # The first stays; the newest two stay, for the motion.
            del self.sightings[1:-2:2]
        seen = np.array([np.isfinite(s.segments[:, 0]) for s in self.sightings], np.int64)
        shared = seen @ seen.T
        first = 0
        while first < len(seen) - 1 and _with_both(shared, first).max() < _MIN_SEGMENTS:
            first += 1
        del self.sightings[:first]
        seen, shared = seen[first:], shared[first:, first:]
        # Of those that share most with both ends the one that shares most with all.
        best = np.lexsort((shared.sum(axis=1), _with_both(shared, 0)))
        self.reference = int(best[-1])
        shown = seen.any(axis=0)
        for sighting in self.sightings:
            sighting.segments = sighting.segments[shown]

    def _followed(self, found: Segments) -> tuple[F64, Bools]:
        """Where the followed segments are now, and which of `found` are none of them."""
        last = self.sightings[-1].segments
        places = last + self._moved()
        n = len(places)
        match, share, offset = np.empty(n, np.int32), np.empty(n), np.empty(n)
        reach = np.full(n, _REACH_PX)
        kernels_associate.vote(places, reach, *found[:3], _COSINE, match, share, offset)
        match[share < _MIN_SHARE] = -1
        now, free = np.full_like(last, np.nan), np.ones(len(found.length), bool)
        for line, segment in _one_to_one(match, np.abs(offset)):
            now[line] = ends(found)[segment]
            free[segment] = False
        return now, free

    def _moved(self) -> F64:
        """Motion of segments' ends (k, 4) over the last frame, 0 if not known."""
        last = self.sightings[-1]
        if len(self.sightings) > 1:
            before = self.sightings[-2]
            if last.number - before.number <= 2:
                return np.asarray(np.nan_to_num(shift_across(before.segments, last.segments)))
        return np.zeros_like(last.segments)


def _with_both(shared: NDArray[np.int64], first: int) -> NDArray[np.int64]:
    """What each frame from `first` on shares with that and with the newest, whichever is less."""
    return np.minimum(shared[first:, first], shared[first:, -1])


def _count(places: F64) -> int:
    return int(np.count_nonzero(np.isfinite(places[:, 0])))


def _longer(places: F64, by: int) -> F64:
    """The same with rows of NaN added."""
    return np.vstack((places, np.full((by, 4), np.nan)))


def shift_across(before: F64, after: F64) -> F64:
    """How far segments (k, 4) moved across themselves, for both ends alike; ends slide."""
    along = after[:, 2:] - after[:, :2]
    normal = np.column_stack((-along[:, 1], along[:, 0]))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    middle = 0.5 * (after[:, 2:] + after[:, :2] - before[:, 2:] - before[:, :2])
    shift = np.sum(middle * normal, axis=1, keepdims=True) * normal
    return np.hstack((shift, shift))


def _one_to_one(match: I32, distance: F64) -> list[tuple[int, int]]:
    order = np.argsort(distance, kind="stable")
    order = order[match[order] >= 0]
    targets, first = np.unique(match[order], return_index=True)
    return [(int(order[k]), int(target)) for target, k in zip(targets, first, strict=True)]
