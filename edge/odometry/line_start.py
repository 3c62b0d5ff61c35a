# SPDX-License-Identifier: Apache-2.0
"""The start where there is little but edges: from the few corners and all straight segments."""

import logging

import numpy as np

from edge.config.lines import SegmentConfig
from edge.config.odometry import OdometryConfig
from edge.lines.detector import SegmentDetector
from edge.lines.work import Clock, LineWork, no_clock
from edge.odometry.line_structure import Found, Seen, reconstruct
from edge.odometry.line_trail import LineTrail, Sighting, shift_across
from edge.odometry.starter import Start
from edge.odometry.structure import Structure
from edge.types import F32, F64, U8, Frame, Pinhole

log = logging.getLogger(__name__)

_MAX_ADJUSTED = 7  # frames, the newest and some before
_MIN_FIT_SHARE = 0.8
_MIN_MOTION_SHARE = 0.006
# Beside the best reconstruction: all residuals, outliers at a pixel, and those of any other.
_MAX_FIT_PX = 0.15
_MIN_RIVAL_RATIO = 1.4
# Two frames in a row agree on the way that the camera went. With that, depths may be less certain
# than those of corners: the first window finds them better.
_SIGMA_SHARE = 1.5
_SAME_COSINE = float(np.cos(np.deg2rad(15.0)))
# Larger images are halved before segments are looked for.
_SMALL_PX = 160_000


def segment_detector(pinhole: Pinhole) -> SegmentDetector:
    """A detector for images of the odometry's working size."""
    config = SegmentConfig(min_length_px=0.03 * (pinhole.width + pinhole.height), max_segments=80)
    return SegmentDetector(config, halve=pinhole.width * pinhole.height > _SMALL_PX)


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
        self._trail = LineTrail(self._size, mask)
        self.reset()

    def reset(self) -> None:
        """Forget all frames."""
        self._trail.reset()
        self._way: F64 | None = None  # that the camera went, if the last frame seemed certain

    @property
    def has_reference(self) -> bool:
        """Whether a reference frame with enough to follow is held."""
        return self._trail.has_enough

    def step(self, frame: Frame, grey: U8) -> Start | None:
        """Follow corners and segments into `grey` (h, w); the start, once it is certain enough."""
        began_ns = self.work.clock()
        found = self._detector.detect(grey, self._mask)
        self.work.add(len(found.length), began_ns)
        self._trail.step(frame, grey, found)
        self._trail.forget_older(self._config.start_max_age_frames)
        return self._attempt() if len(self._trail.sightings) > 2 else None

    def _attempt(self) -> Start | None:
        before, self._way = self._way, None
        reference, last = self._trail.sightings[0], self._trail.sightings[-1]
        alive = np.isfinite(reference.corners[:, 0])
        lines = np.isfinite(reference.segments[:, 0])
        moved = np.linalg.norm(
            shift_across(reference.segments[lines], last.segments[lines])[:, :2], axis=1
        )
        if np.median(moved) < _MIN_MOTION_SHARE * self._size:
            return None
        others = self._trail.sightings[1:]
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
        self, reference: Sighting, chosen: list[Sighting], alive: np.ndarray, lines: np.ndarray
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
        share, sigma = float(np.mean(structure.inlier[corners:] > 0)), _sigma(structure)
        certain = (
            share > _MIN_FIT_SHARE
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
    """Unit vector (3,) from the reference towards the last camera, in the last camera."""
    way = -structure.T_frame_reference[-1][:3, 3]
    return np.asarray(way / max(float(np.linalg.norm(way)), 1e-12))
