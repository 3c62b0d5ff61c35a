# SPDX-License-Identifier: Apache-2.0
"""Corners and edges followed over the last frames: the first frame that still shares enough."""

from dataclasses import dataclass
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from edge.lines import kernels_associate
from edge.lines.line import Segments, ends
from edge.odometry.corner_flow import flatten, followed
from edge.types import F32, F64, I32, U8, Bools, Frame

_Float = TypeVar("_Float", np.float32, np.float64)

# Frames that are kept; every second one goes when there are more.
_MAX_FRAMES = 16
_MAX_CORNERS = 60
# Of the weaker over the stronger curvature: below, a corner is a place on an edge.
_MIN_CORNERNESS = 0.12
_MIN_SEGMENTS = 9  # that the first and the newest frame share
# Segments of neighbouring frames.
_REACH_PX, _COSINE, _MIN_SHARE = 8.0, float(np.cos(np.deg2rad(5.0))), 0.5


@dataclass(slots=True, eq=False)
class Sighting:
    """Where a frame shows what is followed."""

    frame: Frame
    corners: F32  # (n, 2), NaN where not seen
    segments: F64  # (k, 4) ends, NaN where not seen


class LineTrail:
    """Owned by the tracking thread.

    What comes into view is followed from then on, so that the first frame moves up when too little
    of it is left, and need not be begun anew: in a turning camera's sight little stays for long.
    """

    def __init__(self, size_px: int, mask: U8) -> None:
        """`size_px` is the sum of width and height."""
        self._apart_px, self._mask = max(5.0, 0.014 * size_px), mask
        self.reset()

    def reset(self) -> None:
        """Forget all."""
        self.sightings: list[Sighting] = []
        self._previous: U8 | None = None

    @property
    def has_enough(self) -> bool:
        """Whether the newest frame shows enough to be followed."""
        if not self.sightings:
            return False
        last = self.sightings[-1]
        return _is_enough(last)

    def step(self, frame: Frame, grey: U8, found: Segments) -> None:
        """Follow into the next image (h, w), with its segments."""
        flat, at = flatten(grey), ends(found)
        corners, free = np.empty((0, 2), np.float32), np.ones(len(at), bool)
        segments = np.empty((0, 4))
        if self._previous is not None:
            corners = followed(
                self._previous, flat, self.sightings[-1].corners, self._corners_moved()
            )
            segments, free = self._followed_segments(found)
        self._previous = flat
        self._add(frame, corners, segments, self._new_corners(grey, corners), at[free])
        self._let_go()

    def forget_older(self, max_age: int) -> None:
        """Begin no more than so many frames ago."""
        newest = self.sightings[-1].frame.index
        while abs(newest - self.sightings[0].frame.index) > max_age:
            del self.sightings[0]

    def _add(
        self, frame: Frame, corners: F32, segments: F64, new_corners: F32, new_segments: F64
    ) -> None:
        for sighting in self.sightings:
            sighting.corners = _longer(sighting.corners, len(new_corners))
            sighting.segments = _longer(sighting.segments, len(new_segments))
        corners = np.vstack((corners, new_corners))
        self.sightings.append(Sighting(frame, corners, np.vstack((segments, new_segments))))

    def _let_go(self) -> None:
        """Drop what is lost from sight, and the frames that share too little with the newest."""
        last = self.sightings[-1]
        corners, segments = _seen(last.corners), _seen(last.segments)
        for sighting in self.sightings:
            sighting.corners = sighting.corners[corners]
            sighting.segments = sighting.segments[segments]
        first = next(
            k for k, s in enumerate(self.sightings)
            if s is last or _is_enough(s)
        )  # fmt: skip
        del self.sightings[:first]
        if len(self.sightings) > _MAX_FRAMES:
            # The first stays; the newest two stay, for the motion.
            del self.sightings[1:-2:2]

    def _new_corners(self, grey: U8, known: F32) -> F32:
        found = cv2.goodFeaturesToTrack(grey, _MAX_CORNERS, 0.005, self._apart_px, mask=self._mask)
        if found is None:
            return np.empty((0, 2), np.float32)
        at = found.reshape(-1, 2)
        curvature = cv2.cornerEigenValsAndVecs(grey, 5, 3)[..., :2]
        u, v = np.rint(at).astype(int).T
        low, high = np.sort(curvature[v, u], axis=1).T
        good = low > _MIN_CORNERNESS * high
        near = np.linalg.norm(at[:, None] - known[None], axis=2) < self._apart_px
        good &= ~np.any(near, axis=1)
        return np.ascontiguousarray(at[good])

    def _followed_segments(self, found: Segments) -> tuple[F64, Bools]:
        """Where the followed segments are now, and which of `found` are none of them."""
        last = self.sightings[-1].segments
        places = last + self._segments_moved()
        n = len(places)
        match, share, offset = np.empty(n, np.int32), np.empty(n), np.empty(n)
        reach = np.full(n, _REACH_PX)
        kernels_associate.vote(places, reach, *found[:3], _COSINE, True, match, share, offset)
        match[share < _MIN_SHARE] = -1
        now, free = np.full_like(last, np.nan), np.ones(len(found.length), bool)
        for line, segment in _one_to_one(match, np.abs(offset)):
            now[line] = ends(found)[segment]
            free[segment] = False
        return now, free

    def _before_last(self) -> Sighting | None:
        """The frame before the newest one, if they are neighbours."""
        if len(self.sightings) < 2:
            return None
        a, b = self.sightings[-2], self.sightings[-1]
        return None if abs(b.frame.index - a.frame.index) > 2 else a

    def _corners_moved(self) -> F64:
        """Motion of corners (n, 2) over the last frame, 0 if not known."""
        a, b = self._before_last(), self.sightings[-1]
        if a is None:
            return np.zeros_like(b.corners, np.float64)
        return np.asarray(np.nan_to_num(b.corners - a.corners), np.float64)

    def _segments_moved(self) -> F64:
        """The same of segments' ends (k, 4)."""
        a, b = self._before_last(), self.sightings[-1]
        if a is None:
            return np.zeros_like(b.segments)
        return np.asarray(np.nan_to_num(shift_across(a.segments, b.segments)))


def _seen(places: F32 | F64) -> Bools:
    return np.asarray(np.isfinite(places[:, 0]))


def _is_enough(sighting: Sighting) -> bool:
    return int(_seen(sighting.segments).sum()) >= _MIN_SEGMENTS


def _longer(places: NDArray[_Float], by: int) -> NDArray[_Float]:
    """The same with rows of NaN added."""
    return np.vstack((places, np.full((by, places.shape[1]), np.nan, places.dtype)))


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
