# SPDX-License-Identifier: Apache-2.0
"""Lines of the window: straight edges as landmarks beside the points.

A point of a direct window lives as long as its keyframe; a line lives as long as its edge is
seen. Its residuals are distances of segments to it, in all keyframes of the window that see it.
Former keyframes do not hold it: their poses are no longer known better than the window's, and
to be held by them let steps go where the window sees nothing (scale, place), which doubled errors.

Where images have texture, points are better, and lines are not looked for.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from edge.config.lines import PairingConfig
from edge.lines.associate import associate
from edge.lines.line import Lines, Segments, take_segments
from edge.lines.structure import triangulate, views_of
from edge.lines.work import LineWork
from edge.odometry import kernels_lines as kl
from edge.odometry.keyframe import Keyframe
from edge.odometry.line_check import KnownLines
from edge.odometry.line_start import segment_detector
from edge.odometry.line_tracks import KeyframeTracks, View
from edge.odometry.plain import TEXTURED_SHARE, strong_share
from edge.types import F32, F64, I32, U8, Pinhole

# Working-size pixels from a line's projection to its segment: the tracked pose is that good.
_REACH_PX = 4.0
_CAUCHY2 = 9.0
# Energy of one squared sigma, in mean energies of a photometric residual: an edge's points say
# the same thing many times over, a line says it once. With a tenth of this, lines do nothing.
_WORTH, _FIRST_UNIT = 5.0, 500.0
# Squared sigmas beyond which a view shows another edge, and so many times in a row that a line
# is none, or no longer where it was.
_GATE_M2, _MAX_FAILURES = 25.0, 3
_MAX_UNSEEN = 20  # keyframes, after which a line makes room
_MAX_LINES, _MAX_VIEWS = 60, 12
_FIRST_VIEWS = 3  # that are kept always: a line is made anew from them
_MIN_VIEWS = 3
# Errors of segments that their own scatter does not show, in working-size pixels.
_FLOOR_PX = 0.15
_MIN_ENERGY = 8.0  # of a residual of eight pixels, each off by a grey level
# A line that is known worse, as a share of its depth, or in its direction, pairs with anything.
_MAX_SIGMA_SHARE, _MAX_SIGMA_RAD = 0.2, 0.3


@dataclass(slots=True, eq=False)
class Line:
    """One line, in the odometry frame."""

    point: F64
    direction: F64
    span: F64  # (2,) from the point
    views: list[View]
    failures: int = 0
    unseen: int = 0  # keyframes since it was
    retried: bool = False

    def held(self) -> list[View]:
        """Views of keyframes in the window."""
        return [view for view in self.views if view.keyframe is not None]


class _Packed(NamedTuple):
    start: I32
    frame: I32
    T: F64
    middle: F64
    direction2: F64
    length: F64
    sigma: F64
    point: F64
    direction: F64
    H_lines: F64
    b_lines: F64
    H_frames: F64
    m2: F64


class WindowLines:
    """Owned by the thread of the keyframe work."""

    def __init__(self, camera: Pinhole, mask: U8, *, used: bool) -> None:
        self.camera, self._mask, self._used = camera, mask, used
        self.unit = _FIRST_UNIT  # energy of one squared sigma
        self.is_plain = False  # the newest image
        self._detector = segment_detector(camera)
        self.work = LineWork()
        self.clear()

    def clear(self) -> None:
        """Forget all."""
        self.lines: list[Line] = []
        self._tracks = KeyframeTracks(self.camera)
        self._packed: _Packed | None = None

    def known(self) -> KnownLines | None:
        """The lines as they are now."""
        spans = [line.span for line in self.lines]
        return KnownLines(self._as_lines(), np.array(spans)) if spans else None

    def seen_by(self, keyframe: Keyframe) -> int:
        """How many lines a keyframe shows."""
        return sum(view.keyframe is keyframe for line in self.lines for view in line.views)

    def look(self, keyframe: Keyframe, level0: F32) -> None:
        """Look for lines in a new keyframe's image (h, w, 3), if it is plain."""
        self.is_plain = strong_share(level0, self._mask) <= TEXTURED_SHARE
        if not self._used:
            return
        if not self.is_plain:
            self.clear()
            return
        began_ns = self.work.clock()
        grey = np.clip(level0[..., 0] + 0.5, 0, 255).astype(np.uint8)
        segments = self._detector.detect(grey, self._mask)
        self.observe(keyframe, segments)
        self.work.add(len(segments.length), began_ns)

    def observe(self, keyframe: Keyframe, segments: Segments) -> None:
        """Find the known lines among a new keyframe's segments; follow the others."""
        segments = segments._replace(sigma=np.hypot(segments.sigma, _FLOOR_PX))
        taken = np.zeros(len(segments.length), bool)
        if self.lines:
            pairs = associate(
                self._as_lines(),
                np.array([line.span for line in self.lines]),
                segments,
                self.camera,
                keyframe.T_cam_odom,
                _REACH_PX,
                PairingConfig(min_length_px=15.0),
            )
            for line, segment in zip(pairs.line, pairs.segment, strict=True):
                self.lines[line].views.append(View(segments, int(segment), keyframe, np.eye(4)))
                taken[segment] = True
        for track in self._tracks.step(segments, ~taken, keyframe):
            line = self._made(track.views) if len(self.lines) < _MAX_LINES else None
            if line is not None:
                self.lines.append(line)
                self._tracks.drop(track)

    def _as_lines(self) -> Lines:
        n = len(self.lines)
        point = np.array([line.point for line in self.lines])
        direction = np.array([line.direction for line in self.lines])
        return Lines(point, direction, np.zeros((n, 4, 4)))

    def _made(self, views: list[View]) -> Line | None:
        seen = [(view.segments, view.index, view.T_cam_odom) for view in views]
        found = triangulate([views_of(seen)], self.camera)
        if np.max(found.m2[0]) > _GATE_M2 or not self._is_sure(found.lines, views):
            return None
        point, direction, span = found.lines.point[0], found.lines.direction[0], found.span[0]
        if not self._runs_like(point, direction, views[-1]):
            direction, span = -direction, -span[::-1]
        return Line(point, direction, span, list(views))

    def _runs_like(self, point: F64, direction: F64, view: View) -> bool:
        """Whether a line's direction is that of its segment, and not the opposite."""
        T, p = view.T_cam_odom, self.camera
        P, D = T[:3, :3] @ point + T[:3, 3], T[:3, :3] @ direction
        moved = np.array([p.fx * (D[0] * P[2] - P[0] * D[2]), p.fy * (D[1] * P[2] - P[1] * D[2])])
        return bool(moved @ view.segments.direction[view.index] > 0.0)

    def _is_sure(self, line: Lines, views: list[View]) -> bool:
        """Whether a line lies ahead of its views, and how deep is known at least roughly."""
        T = np.array([view.T_cam_odom for view in views])
        depth = T[:, 2, :3] @ line.point[0] + T[:, 2, 3]
        sigma = np.sqrt(np.diag(line.covariance[0]))
        return bool(
            depth.min() > 0.0
            and sigma[:2].max() < _MAX_SIGMA_SHARE * depth.min()
            and sigma[2:].max() < _MAX_SIGMA_RAD
        )

    def freeze(self, keyframe: Keyframe) -> None:
        """A keyframe leaves: its views stay, with its pose as it is."""
        T = keyframe.T_cam_odom
        for line in self.lines:
            for view in line.views:
                view.freeze(keyframe, T)
            if len(line.views) > _MAX_VIEWS:
                del line.views[_FIRST_VIEWS]
        self._tracks.freeze(keyframe, T)

    # --- optimisation ---

    def pack(self, keyframes: list[Keyframe]) -> None:
        """Take all lines into arrays, for `add`, `move` and `read_back`."""
        self._packed = None
        if not self.lines:
            return
        where = {id(keyframe): k for k, keyframe in enumerate(keyframes)}
        held = [line.held() for line in self.lines]
        views = [view for of_line in held for view in of_line]
        if not views:
            return
        start = np.cumsum([0] + [len(of_line) for of_line in held]).astype(np.int32)
        rows = [take_segments(v.segments, np.array([v.index])) for v in views]
        columns = [np.concatenate(column) for column in zip(*rows, strict=True)]
        n, v = len(self.lines), len(views)
        frame = [where[id(w.keyframe)] for w in views]
        self._packed = _Packed(
            start,
            np.array(frame, np.int32),
            np.array([view.T_cam_odom for view in views]),
            columns[0],
            columns[1],
            columns[2],
            columns[3],
            np.array([line.point for line in self.lines]),
            np.array([line.direction for line in self.lines]),
            np.empty((n, 4, 4)),
            np.empty((n, 4)),
            np.empty((v, 6, 4)),
            np.empty(v),
        )

    def add(self, keyframes: list[Keyframe], damping: float, H: F64, b: F64) -> float:
        """Add what lines say to the frames' system; their cost."""
        p = self._packed
        if p is None:
            return 0.0
        for k, keyframe in enumerate(keyframes):
            p.T[p.frame == k] = keyframe.T_cam_odom
        return kl.line_system(
            p.start, p.frame, p.T, p.middle, p.direction2, p.length, p.sigma, p.point,
            p.direction, self.camera, self.unit, _CAUCHY2, damping, H, b, p.H_lines, p.b_lines,
            p.H_frames, p.m2,
        )  # fmt: skip

    def cost(self, keyframes: list[Keyframe]) -> float:
        """Cost at the current state."""
        if self._packed is None:
            return 0.0
        n = 8 * len(keyframes)
        return self.add(keyframes, 0.0, np.zeros((n, n)), np.zeros(n))

    def move(self, dx: F64, damping: float) -> None:
        """Move the lines with a step of the frames."""
        p = self._packed
        if p is not None:
            kl.move_lines(
                p.start, p.frame, p.H_lines, p.b_lines, p.H_frames, dx, self.unit, damping,
                p.point, p.direction,
            )  # fmt: skip

    def state(self) -> tuple[F64, F64] | None:
        """What `restore` takes back."""
        p = self._packed
        return None if p is None else (p.point.copy(), p.direction.copy())

    def restore(self, state: tuple[F64, F64] | None) -> None:
        """Undo moves since `state`."""
        if self._packed is not None and state is not None:
            self._packed.point[:], self._packed.direction[:] = state

    def read_back(self, keyframes: list[Keyframe], mean_energy: float) -> None:
        """Keep what the optimisation found; views that do not fit go, and lines without views.

        mean_energy : of a photometric residual [grey^2]
        """
        self.cost(keyframes)
        p, self._packed = self._packed, None
        self.unit = _WORTH * max(mean_energy, _MIN_ENERGY)
        if p is None:
            return
        for i, line in enumerate(self.lines):
            line.point, line.direction = p.point[i].copy(), p.direction[i].copy()
            fits = p.m2[p.start[i] : p.start[i + 1]] < _GATE_M2
            if line.views[-1].keyframe is keyframes[-1]:
                line.failures, line.unseen = 0 if fits[-1] else line.failures + 1, 0
            else:
                line.unseen += 1
            strays = [view for view, good in zip(line.held(), fits, strict=True) if not good]
            line.views = [view for view in line.views if view not in strays]
        self.lines = [line for line in map(self._kept, self.lines) if line is not None]

    def _kept(self, line: Line) -> Line | None:
        """The line; or made anew from its first views where it failed too often; or none."""
        if len(line.views) < _MIN_VIEWS or line.unseen > _MAX_UNSEEN:
            return None
        if line.failures < _MAX_FAILURES:
            return line
        again = None if line.retried else self._made(line.views[: _MIN_VIEWS + 1])
        if again is not None:
            again.retried = True
        return again
