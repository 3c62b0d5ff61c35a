# SPDX-License-Identifier: Apache-2.0
"""The start where there is little but edges: from the few corners and all straight segments."""

import logging
from dataclasses import dataclass

import cv2
import numpy as np

from edge.config.lines import SegmentConfig
from edge.config.odometry import OdometryConfig
from edge.lines import kernels_associate
from edge.lines.detector import SegmentDetector
from edge.lines.line import Segments, ends
from edge.lines.work import Clock, LineWork, no_clock
from edge.odometry.line_structure import Found, Seen, reconstruct
from edge.odometry.starter import Start, flatten, flow
from edge.odometry.structure import Structure
from edge.types import F32, F64, I32, U8, Frame, Pinhole

log = logging.getLogger(__name__)

# Frames kept between the reference and now, and those of the adjustment, as in `Starter`.
_MAX_FRAMES, _MAX_ADJUSTED = 16, 7
_MAX_CORNERS = 60
# Of the weaker over the stronger curvature: below, a corner is a place on an edge.
_MIN_CORNERNESS = 0.12
_MIN_CORNERS, _MIN_SEGMENTS = 6, 6
_MIN_FEATURES = 20  # corners and segments together
_MIN_FIT_CORNERS = 9
_MIN_FIT_SHARE = 0.8
_MIN_MOTION_SHARE = 0.006
# Beside the best reconstruction: all residuals, outliers at a pixel, and those of any other.
_MAX_FIT_PX = 0.3
_MIN_RIVAL_RATIO = 1.3
# Depths are known this much better than corners alone must tell them, and two frames in a row
# agree on the way that the camera went: of 66 starts from anywhere in simulated rooms, 9 went more
# than 20 degrees astray before, of 51 one does now.
_SIGMA_SHARE = 0.75
_SAME_COSINE = float(np.cos(np.deg2rad(15.0)))
_MAX_ROUND_TRIP_PX = 0.7
# Segments of neighbouring frames.
_REACH_PX, _COSINE, _MIN_SHARE = 8.0, float(np.cos(np.deg2rad(5.0))), 0.5
# Larger images are halved before segments are looked for.
_SMALL_PX = 160_000


def segment_detector(pinhole: Pinhole) -> SegmentDetector:
    """A detector for images of the odometry's working size."""
    config = SegmentConfig(min_length_px=0.03 * (pinhole.width + pinhole.height), max_segments=80)
    return SegmentDetector(config, halve=pinhole.width * pinhole.height > _SMALL_PX)


@dataclass(slots=True, eq=False)
class _Tracked:
    frame: Frame
    corners: F32  # (n, 2) where the reference's corners are, NaN once lost
    segments: F64  # (k, 4) ends of what shows the reference's segments, NaN once lost


class LineStarter:
    """Owned by the tracking thread. Like `Starter`, for images of too few corners."""

    def __init__(
        self, pinhole: Pinhole, mask: U8, config: OdometryConfig, clock: Clock = no_clock
    ) -> None:
        """`clock` tells what finding segments costs."""
        self._pinhole, self._mask, self._config = pinhole, mask, config
        self.work = LineWork(clock)
        self._detector = segment_detector(pinhole)
        self._size = pinhole.width + pinhole.height
        self.reset()

    def reset(self) -> None:
        """Forget the reference."""
        self._tracked: list[_Tracked] = []
        self._previous: U8 | None = None
        self._age = 0
        self._way: F64 | None = None  # that the camera went, if the last frame seemed certain

    @property
    def has_reference(self) -> bool:
        """Whether a reference frame with enough to follow is held."""
        return bool(self._tracked)

    def step(self, frame: Frame, grey: U8) -> Start | None:
        """Follow corners and segments into `grey` (h, w); the start, once it is certain enough."""
        began_ns = self.work.clock()
        found = self._detector.detect(grey, self._mask)
        self.work.add(len(found.length), began_ns)
        flat = flatten(grey)
        if self._previous is None or not self._follow(frame, flat, found):
            self._begin(frame, grey, flat, found)
            return None
        self._previous = flat
        self._age += 1
        start = self._attempt()
        if start is None and self._age > self._config.start_max_age_frames:
            self._begin(frame, grey, flat, found)
        return start

    def _begin(self, frame: Frame, grey: U8, flat: U8, found: Segments) -> None:
        self.reset()
        corners = self._corners(grey)
        if len(corners) < _MIN_CORNERS or len(found.length) < _MIN_SEGMENTS:
            return
        self._tracked = [_Tracked(frame, corners, ends(found))]
        self._previous = flat

    def _corners(self, grey: U8) -> F32:
        apart = max(5.0, 0.014 * self._size)
        corners = cv2.goodFeaturesToTrack(grey, _MAX_CORNERS, 0.005, apart, mask=self._mask)
        if corners is None:
            return np.empty((0, 2), np.float32)
        at = corners.reshape(-1, 2)
        curvature = cv2.cornerEigenValsAndVecs(grey, 5, 3)[..., :2]
        u, v = np.rint(at).astype(int).T
        low, high = np.sort(curvature[v, u], axis=1).T
        return np.ascontiguousarray(at[low > _MIN_CORNERNESS * high])

    def _follow(self, frame: Frame, flat: U8, found: Segments) -> bool:
        """Whether enough of the reference is found in the next frame."""
        corners, segments = self._followed_corners(flat), self._followed_segments(found)
        n = int(np.isfinite(corners[:, 0]).sum())
        k = int(np.isfinite(segments[:, 0]).sum())
        if n < _MIN_CORNERS or k < _MIN_SEGMENTS or n + k < _MIN_FEATURES:
            return False
        self._tracked.append(_Tracked(frame, corners, segments))
        if len(self._tracked) > _MAX_FRAMES:
            del self._tracked[1:-2:2]
        return True

    def _followed_corners(self, flat: U8) -> F32:
        assert self._previous is not None
        last = self._tracked[-1].corners
        alive = np.flatnonzero(np.isfinite(last[:, 0]))
        before = np.ascontiguousarray(last[alive])
        guess = before + self._moved(1)[alive].astype(np.float32)
        now, good = flow(self._previous, flat, before, guess)
        back, returned = flow(flat, self._previous, now, before.copy())
        good &= returned & (np.linalg.norm(back - before, axis=1) < _MAX_ROUND_TRIP_PX)
        good &= np.all((now > 2) & (now < np.array(flat.shape[::-1]) - 3), axis=1)
        corners = np.full_like(last, np.nan)
        corners[alive[good]] = now[good]
        return corners

    def _followed_segments(self, found: Segments) -> F64:
        last = self._tracked[-1].segments
        places = last + self._moved(2)
        n = len(places)
        match, share, offset = np.empty(n, np.int32), np.empty(n), np.empty(n)
        reach = np.full(n, _REACH_PX)
        kernels_associate.vote(places, reach, *found[:3], _COSINE, True, match, share, offset)
        match[share < _MIN_SHARE] = -1
        now = np.full_like(last, np.nan)
        for line, segment in _one_to_one(match, np.abs(offset)):
            now[line] = ends(found)[segment]
        return now

    def _moved(self, what: int) -> F64:
        """Motion of corners (1) or segments' ends (2) over the last frame, 0 if not known."""
        if len(self._tracked) < 2:
            return np.zeros_like((self._tracked[-1].corners, self._tracked[-1].segments)[what - 1])
        a, b = self._tracked[-2], self._tracked[-1]
        if b.frame.index - a.frame.index > 2:
            return np.zeros_like((b.corners, b.segments)[what - 1])
        if what == 1:
            return np.asarray(np.nan_to_num(b.corners - a.corners), np.float64)
        return np.nan_to_num(_shift_across(a.segments, b.segments))

    def _attempt(self) -> Start | None:
        before, self._way = self._way, None
        reference, last = self._tracked[0], self._tracked[-1]
        alive = np.isfinite(last.corners[:, 0])
        lines = np.isfinite(last.segments[:, 0])
        moved = np.linalg.norm(last.corners[alive] - reference.corners[alive], axis=1)
        if np.median(moved) < _MIN_MOTION_SHARE * self._size:
            return None
        others = self._tracked[1:]
        picks = np.unique(np.linspace(0, len(others) - 1, _MAX_ADJUSTED).round().astype(int))
        chosen = [others[i] for i in picks]
        focal_px = 0.5 * (self._pinhole.fx + self._pinhole.fy)
        found = reconstruct(self._seen(reference, chosen, alive, lines), focal_px)
        if found is None or not self._is_confirmed(found, int(alive.sum()), before):
            return None
        structure = found.structure
        inlier = structure.inlier[: alive.sum()] > 0
        return Start(
            frames=(reference.frame, *(t.frame for t in chosen)),
            T_cam_reference=(np.eye(4), *structure.T_frame_reference),
            pixels=reference.corners[alive][inlier],
            inverse_depth=structure.inverse_depth[: alive.sum()][inlier].astype(np.float32),
            max_relative_sigma=_sigma(structure),
        )

    def _seen(
        self, reference: _Tracked, chosen: list[_Tracked], alive: np.ndarray, lines: np.ndarray
    ) -> Seen:
        corner_at = np.stack([self._normalise(t.corners[alive]) for t in chosen])
        line = np.stack([self._line(t.segments[lines]) for t in chosen])
        return Seen(
            self._normalise(reference.corners[alive]),
            np.nan_to_num(corner_at),
            np.isfinite(corner_at[..., 0]).astype(np.uint8),
            self._normalise(reference.segments[lines].reshape(-1, 2)),
            np.repeat(np.nan_to_num(line), 2, axis=1),
            np.repeat(np.isfinite(line[..., 0]).astype(np.uint8), 2, axis=1),
        )

    def _line(self, segments: F64) -> F64:
        """Lines (k, 3) a x + b y + c through ends (k, 4), in focal lengths."""
        first, last = self._normalise(segments[:, :2]), self._normalise(segments[:, 2:])
        along = last - first
        along /= np.linalg.norm(along, axis=1, keepdims=True)
        normal = np.column_stack((-along[:, 1], along[:, 0]))
        return np.column_stack((normal, -np.sum(normal * first, axis=1)))

    def _is_confirmed(self, found: Found, corners: int, before: F64 | None) -> bool:
        """Whether a reconstruction is certain, and so was the one before, to the same side."""
        if self._is_certain(found, corners):
            self._way = _way(found.structure)
        if before is None or self._way is None:
            return False
        return bool(before @ self._way > _SAME_COSINE)

    def _is_certain(self, found: Found, corners: int) -> bool:
        structure = found.structure
        share, sigma = float(np.mean(structure.inlier > 0)), _sigma(structure)
        certain = (
            share > _MIN_FIT_SHARE
            and np.count_nonzero(structure.inlier[:corners]) >= _MIN_FIT_CORNERS
            and found.fit_px < _MAX_FIT_PX
            and sigma < _SIGMA_SHARE * self._config.start_max_depth_sigma
            and found.rival_px > _MIN_RIVAL_RATIO * found.fit_px
        )
        log.debug(
            "start by lines n=%d inliers=%.2f fit_px=%.3f rival_px=%.3f sigma=%.3f certain=%s",
            len(structure.inlier),
            share,
            found.fit_px,
            found.rival_px,
            sigma,
            certain,
        )
        return bool(certain)

    def _normalise(self, pixels: F32 | F64) -> F64:
        p = self._pinhole
        return np.asarray((pixels.astype(np.float64) - [p.cx, p.cy]) / [p.fx, p.fy])


def _sigma(structure: Structure) -> float:
    inlier = structure.inlier > 0
    return float(np.median(structure.relative_sigma[inlier])) if np.any(inlier) else np.inf


def _way(structure: Structure) -> F64:
    """Unit vector (3,) from the reference towards the last camera, in the reference."""
    T = structure.T_frame_reference[-1]
    way = -T[:3, :3].T @ T[:3, 3]
    return np.asarray(way / max(float(np.linalg.norm(way)), 1e-12))


def _shift_across(before: F64, after: F64) -> F64:
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
