# SPDX-License-Identifier: Apache-2.0
"""Frames of plain images, whose edges in the window tell where brightness alone has slipped.

Along an edge all points look alike: there the noise of an image says as much as its brightness, and
the best agreement may lie many sigmas of its own away. The edges as lines say how well each
direction is known. Where both agree, the points are more exact and nothing is changed.
"""

from dataclasses import dataclass, replace

import numpy as np

from edge.config.lines import PairingConfig
from edge.geometry import se3
from edge.lines import pose
from edge.lines.associate import associate
from edge.lines.line import Lines, Segments, take, take_segments
from edge.lines.pose import LinePose
from edge.lines.work import Clock, LineWork, no_clock
from edge.odometry.line_start import segment_detector
from edge.types import F32, F64, U8, Mat4, Mat6, Pinhole

# Working-size pixels from a line's projection to its segment: a motion foretold is that good.
_REACH_PX = 6.0
# Errors of segments that their own scatter does not show [working-size pixels].
_FLOOR_PX = 0.15
# Pairs, and the share of them, that must agree within the gate (two freedoms each).
_MIN_PAIRS, _MIN_SHARE, _PAIR_GATE = 4, 0.8, 16.0
# Of six freedoms, one right pose in 20,000 is beyond; right ones were far below, slips at hundreds.
_GATE = 30.0
# What is wrong with the lines themselves, as a share of the depth and in rad.
_FLOOR = 1e-3


@dataclass(frozen=True, slots=True, eq=False)
class KnownLines:
    """Lines of the window when a reference was made, in the odometry frame."""

    lines: Lines
    span: F64  # (n, 2)


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """A pose of a frame, and the information of a twist on its left."""

    T_cam_odom: Mat4
    information: Mat6


class LineCheck:
    """Owned by the thread that tracks."""

    def __init__(self, camera: Pinhole, mask: U8, clock: Clock = no_clock) -> None:
        """`clock` tells what looking for lines costs."""
        self._camera, self._mask = camera, mask
        self._detector = segment_detector(camera)
        self.work = LineWork(clock)

    def contradicted(
        self, seen: Seen, level0: F32, known: KnownLines, foretold: Mat4, depth: float
    ) -> Seen | None:
        """What to believe instead of `seen`, by its image (h, w, 3): as `contradicted_by`."""
        began_ns = self.work.clock()
        grey = np.clip(level0[..., 0] + 0.5, 0, 255).astype(np.uint8)
        segments = self._detector.detect(grey, self._mask)
        self.work.add(len(segments.length), began_ns)
        segments = segments._replace(sigma=np.hypot(segments.sigma, _FLOOR_PX))
        return self.contradicted_by(segments, seen, known, foretold, depth)

    def contradicted_by(
        self, segments: Segments, seen: Seen, known: KnownLines, foretold: Mat4, depth: float
    ) -> Seen | None:
        """What to believe instead of `seen`, by its image's segments; None where lines agree.

        foretold : T_cam_odom by the motion before
        depth : of the scene, in units of the odometry
        """
        told = self._told(known, segments, (foretold, seen.T_cam_odom))
        return None if told is None else reconciled(seen, told, depth)

    def _told(
        self, known: KnownLines, segments: Segments, guesses: tuple[Mat4, ...]
    ) -> LinePose | None:
        """Pose by lines from the guess that makes most of them agree."""
        best, most = None, _MIN_PAIRS - 1
        config = PairingConfig(min_length_px=15.0)
        for guess in guesses:
            pairs = associate(
                known.lines, known.span, segments, self._camera, guess, _REACH_PX, config,
            )  # fmt: skip
            if len(pairs.line) <= most:
                continue
            shown = take_segments(segments, pairs.segment)
            found = pose.refine(take(known.lines, pairs.line), shown, self._camera, guess)
            agree = int(np.count_nonzero(found.m2 < _PAIR_GATE))
            if agree > most and agree >= _MIN_SHARE * len(pairs.line):
                best, most = found, agree
        return best


def reconciled(seen: Seen, told: LinePose, depth: float) -> Seen | None:
    """The pose between two that contradict each other; None where they do not.

    The points' information shrinks until they are as far off as they may be by chance.
    """
    apart = se3.log(seen.T_cam_odom @ se3.inverse(told.T_cam_lines))
    floor = _FLOOR * np.array([depth, depth, depth, 1.0, 1.0, 1.0])
    by_lines = np.linalg.inv(told.covariance + np.diag(floor**2))
    m2 = float(apart @ by_lines @ apart)
    if not m2 > _GATE:
        return None
    by_points = seen.information * min(1.0, 6.0 / m2)
    both = by_points + by_lines
    T_cam_odom = se3.exp(np.linalg.solve(both, by_points @ apart)) @ told.T_cam_lines
    return replace(seen, T_cam_odom=T_cam_odom, information=both)
