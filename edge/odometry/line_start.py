# SPDX-License-Identifier: Apache-2.0
"""The start where there is little but edges: from how all straight segments moved."""

import logging

import numpy as np

from edge.config.lines import SegmentConfig
from edge.config.odometry import OdometryConfig
from edge.geometry import se3
from edge.lines.detector import SegmentDetector
from edge.lines.work import Clock, LineWork, no_clock
from edge.odometry.line_crossings import crossings, still_meet
from edge.odometry.line_structure import Found, Seen, reconstruct, scatter_rad, way_of
from edge.odometry.line_trail import LineTrail, Sighting, shift_across
from edge.odometry.room_axes import planes, turned
from edge.odometry.start_prior import of_all_frames
from edge.odometry.starter import Start
from edge.odometry.structure import Structure
from edge.types import F64, U8, Frame, Pinhole

log = logging.getLogger(__name__)

_MAX_ADJUSTED = 9  # frames beside the one that they are held against
_MIN_FIT_SHARE = 0.7
_MIN_MOTION_SHARE = 0.006
# Share of depths that must be known so well: an edge along which the camera goes has none. How
# the camera's way scatters says whether a start is right; waiting for depths made none more so.
_KNOWN, _MAX_DEPTH_SIGMA = 0.3, 0.1
# Beside the best reconstruction: all residuals, outliers at the limit, and those of any other.
_MIN_RIVAL_RATIO = 1.4
# The last tries, all certain, agree on the way that the camera went.
_TRIES, _SAME_COSINE = 5, float(np.cos(np.deg2rad(10.0)))
# By this the way may scatter in half of them, as parts of what is seen are left out: twice as far
# after so many tries that would do but for that. Starts 15 degrees off scattered by 15 to 20,
# good ones by 1 to 5, at times 10; the longer the way the less, and frames are followed back.
_MAX_SCATTER_RAD, _PATIENCE = float(np.deg2rad(7.0)), 20
# Larger images are halved before segments are looked for.
_SMALL_PX = 160_000
# What interpolation leaves of an edge's place: plain edges of simulated rooms are so exact.
_FLOOR_PX = 0.04


def segment_detector(pinhole: Pinhole) -> SegmentDetector:
    """A detector for images of the odometry's working size."""
    shortest_px = 0.03 * (pinhole.width + pinhole.height)
    config = SegmentConfig(min_length_px=shortest_px, max_segments=80, floor_px=_FLOOR_PX)
    return SegmentDetector(config, halve=pinhole.width * pinhole.height > _SMALL_PX)


class LineStarter:
    """Owned by the tracking thread. Like `Starter`, for images of too few corners."""

    def __init__(
        self, pinhole: Pinhole, mask: U8, config: OdometryConfig, clock: Clock = no_clock
    ) -> None:
        """`clock` tells what finding segments costs."""
        self._pinhole, self._mask, self._config = pinhole, mask, config
        self._focal_px = 0.5 * (pinhole.fx + pinhole.fy)
        self.work = LineWork(clock)
        self._detector = segment_detector(pinhole)
        self._size = pinhole.width + pinhole.height
        self._trail = LineTrail()
        self.reset()

    def reset(self) -> None:
        """Forget all frames."""
        self._trail.reset()
        self._forget_tries()

    def _forget_tries(self) -> None:
        # Of the last tries in a row: the way that the camera went, and how that scatters.
        self._ways: list[F64] = []
        self._scatters_rad: list[float] = []
        self._waited = 0  # of them, that agreed on a way

    @property
    def has_reference(self) -> bool:
        """Whether a frame with enough to follow is held."""
        return self._trail.has_enough

    def step(self, frame: Frame, grey: U8) -> Start | None:
        """Follow segments into `grey` (h, w); the start, once it is certain enough."""
        began_ns = self.work.clock()
        found = self._detector.detect(grey, self._mask)
        self.work.add(len(found.length), began_ns)
        self._trail.step(frame, found, self._config.start_max_age_frames)
        return self._attempt() if len(self._trail.sightings) > 2 else None

    def _attempt(self) -> Start | None:
        sightings, place = self._trail.sightings, self._trail.reference
        chosen = self._chosen()
        found = None
        if self._has_moved():
            others = [sightings[k] for k in chosen if k != place]
            seen = self._seen(sightings[place], others, chosen.index(place))
            found = reconstruct(seen, self._focal_px)
        if found is None or not self._is_confirmed(found, seen):
            return None
        poses = list(found.structure.T_frame_reference)
        poses.insert(chosen.index(place), np.eye(4))
        T_reference_first = se3.inverse(poses[0])
        return Start(
            frames=tuple(sightings[k].frame for k in chosen),
            T_cam_reference=tuple(T @ T_reference_first for T in poses),
            pixels=np.empty((0, 2), np.float32),
            inverse_depth=np.empty(0, np.float32),
            max_relative_sigma=_sigma(found.structure),
            information=of_all_frames(found.information, poses, chosen.index(place)),
        )

    def _chosen(self) -> list[int]:
        """Numbers of an even choice of sightings, the first, the newest and the reference in it."""
        n = len(self._trail.sightings)
        picks = np.linspace(0, n - 1, _MAX_ADJUSTED).round().astype(int)
        return sorted({*picks.tolist(), self._trail.reference})

    def _has_moved(self) -> bool:
        """Whether what the reference shows has moved enough for a try."""
        sightings = self._trail.sightings
        reference = sightings[self._trail.reference].segments
        for other in (sightings[0].segments, sightings[-1].segments):
            both = np.isfinite(reference[:, 0]) & np.isfinite(other[:, 0])
            moved = np.linalg.norm(shift_across(reference[both], other[both])[:, :2], axis=1)
            if np.median(moved) > _MIN_MOTION_SHARE * self._size:
                return True
        self._forget_tries()
        return False

    def _seen(self, reference: Sighting, others: list[Sighting], place: int) -> Seen:
        used = np.isfinite(reference.segments[:, 0])
        used &= np.sum([np.isfinite(s.segments[:, 0]) for s in others], axis=0) >= 2
        pixels = reference.segments[used]
        segments = [s.segments[used] for s in others]
        meet = crossings(pixels)
        ends = self._normalise(pixels)
        line = [_lines(self._normalise(s)) for s in segments]
        visible = np.stack([np.isfinite(s[:, 0]) for s in segments])
        met = np.stack([still_meet(s, meet) for s in segments])
        at_ends = np.stack(
            [np.stack((a, np.zeros_like(a)), axis=1).repeat(2, axis=0) for a in line]
        )
        at_meetings = np.stack([np.stack((a[meet.one], a[meet.other]), axis=1) for a in line])
        turns = turned(
            planes(ends, self._focal_px),
            [planes(self._normalise(s), self._focal_px) for s in segments],
            place,
            self._focal_px,
        )
        return Seen(
            edges=len(pixels),
            place=place,
            rays=np.vstack((ends.reshape(-1, 2), self._normalise(meet.pixels))),
            line=np.concatenate((at_ends, at_meetings), axis=1),
            visible=np.hstack((visible.repeat(2, axis=1), met)).astype(np.uint8),
            turned=turns,
        )

    def _is_confirmed(self, found: Found, seen: Seen) -> bool:
        """Whether a reconstruction is certain, and so were those before, to the same side."""
        way = way_of(found.structure.T_frame_reference, seen.place)
        if not self._is_certain(found):
            self._forget_tries()
            return False
        self._ways = [*self._ways[1 - _TRIES :], way]
        scatter = scatter_rad(found, seen, self._focal_px)
        self._scatters_rad = [*self._scatters_rad[1 - _TRIES :], scatter]
        agree = all(float(way @ other) > _SAME_COSINE for other in self._ways)
        if len(self._ways) < _TRIES or not agree:
            return False
        self._waited += 1
        most_rad = _MAX_SCATTER_RAD * (1.0 + self._waited / _PATIENCE)
        return float(np.median(self._scatters_rad)) < most_rad

    def _is_certain(self, found: Found) -> bool:
        structure = found.structure
        share, sigma = float(np.mean(structure.inlier > 0)), _sigma(structure)
        certain = (
            share > _MIN_FIT_SHARE
            and sigma < _MAX_DEPTH_SIGMA
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

    def _normalise(self, pixels: F64) -> F64:
        """Places (k, 2) or ends (k, 4) in focal lengths from the axis."""
        p, times = self._pinhole, pixels.shape[1] // 2
        return np.asarray((pixels - [p.cx, p.cy] * times) / ([p.fx, p.fy] * times))


def _lines(ends: F64) -> F64:
    """Lines (k, 3) a x + b y + c through ends (k, 4), zeros where they are NaN."""
    along = ends[:, 2:] - ends[:, :2]
    along = along / np.linalg.norm(along, axis=1, keepdims=True)
    normal = np.column_stack((-along[:, 1], along[:, 0]))
    return np.asarray(
        np.nan_to_num(np.column_stack((normal, -np.sum(normal * ends[:, :2], axis=1))))
    )


def _sigma(structure: Structure) -> float:
    """Uncertainty of the depths that are known best, relative."""
    inlier = structure.inlier > 0
    sigma = structure.relative_sigma[inlier]
    return float(np.quantile(sigma, _KNOWN)) if len(sigma) else np.inf
