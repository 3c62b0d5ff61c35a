# SPDX-License-Identifier: Apache-2.0
"""Lines of the window: straight edges as landmarks beside the points.

A point of a direct window lives as long as its keyframe; a line lives as long as its edge is
seen. Its residuals are distances of segments to it, in all keyframes of the window that see it.
Former keyframes do not hold it: their poses are no longer known better than the window's, and
to be held by them let steps go where the window sees nothing (scale, place), which doubled errors.

Where images have texture, points are better, and lines are not looked for.
"""

from typing import NamedTuple

import numpy as np

from edge.config.lines import PairingConfig
from edge.lines.associate import associate
from edge.lines.line import Lines, Segments, take_segments
from edge.lines.work import LineWork
from edge.odometry import kernels_lines as kl
from edge.odometry.keyframe import Keyframe
from edge.odometry.line_landmark import MIN_VIEWS, STRAY_PX, Line, made, off_px
from edge.odometry.line_start import segment_detector
from edge.odometry.line_tracks import KeyframeTracks, View
from edge.odometry.plain import TEXTURED_SHARE, strong_share
from edge.types import F32, F64, I32, U8, Pinhole

# Working-size pixels from a line's projection to its segment: the tracked pose is that good.
_REACH_PX = 4.0
# Energy of one squared sigma, in mean energies of a photometric residual: an edge's points say
# the same thing many times over and follow it into whatever minimum is near, a line says it once.
# With a quarter of this, windows of plain rooms stay as slanted as their start left them.
_WORTH, _FIRST_UNIT = 20.0, 2000.0
# Squared sigmas at which a view loses half of its weight. Segments are right to a few hundredths
# of a pixel or, where two edges were joined, wrong by half of one: many lines find together first
# which are which.
_CAUCHY2, _WIDE_CAUCHY2, _MANY_LINES = 9.0, 25.0, 6
_MAX_FAILURES = 3  # in a row, after which a line is none, or no longer where it was
_MAX_UNSEEN = 20  # keyframes, after which a line makes room
_MAX_LINES, _MAX_VIEWS = 60, 12
_FIRST_VIEWS = 3  # that are kept always: a line is made anew from them
_MIN_ENERGY = 8.0  # of a residual of eight pixels, each off by a grey level


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
        self.cauchy2 = _CAUCHY2  # where views lose their weight
        self.is_plain = False  # the newest image
        self._detector = segment_detector(camera)
        self.work = LineWork()
        self.clear()

    def clear(self) -> None:
        """Forget all."""
        self.lines: list[Line] = []
        self._tracks = KeyframeTracks(self.camera)
        self._packed: _Packed | None = None
        self._trusted: list[Line] = []  # that are packed

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
            line = made(track.views, self.camera) if len(self.lines) < _MAX_LINES else None
            if line is not None:
                self.lines.append(line)
                self._tracks.drop(track)

    def _as_lines(self) -> Lines:
        point = np.array([line.point for line in self.lines])
        direction = np.array([line.direction for line in self.lines])
        return Lines(point, direction, np.zeros((len(point), 4, 4)))

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

    @property
    def scales(self) -> tuple[float, ...]:
        """Values of `cauchy2` with which to optimise, one after another."""
        many = self.is_plain and len(self.lines) >= _MANY_LINES
        return (_WIDE_CAUCHY2, _CAUCHY2) if many else (_CAUCHY2,)

    def pack(self, keyframes: list[Keyframe]) -> None:
        """Take the trusted lines into arrays, for `add`, `move` and `read_back`."""
        self.lines = [line for line in self.lines if line.is_trusted or line.try_out(self.camera)]
        self._packed, self._trusted = None, [line for line in self.lines if line.is_trusted]
        where = {id(keyframe): k for k, keyframe in enumerate(keyframes)}
        held = [line.held() for line in self._trusted]
        views = [view for of_line in held for view in of_line]
        if not views:
            return
        start = np.cumsum([0] + [len(of_line) for of_line in held]).astype(np.int32)
        rows = [take_segments(v.segments, np.array([v.index])) for v in views]
        columns = [np.concatenate(column) for column in zip(*rows, strict=True)]
        n, v = len(held), len(views)
        frame = [where[id(w.keyframe)] for w in views]
        self._packed = _Packed(
            start,
            np.array(frame, np.int32),
            np.array([view.T_cam_odom for view in views]),
            columns[0],
            columns[1],
            columns[2],
            columns[3],
            np.array([line.point for line in self._trusted]),
            np.array([line.direction for line in self._trusted]),
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
            p.direction, self.camera, self.unit, self.cauchy2, damping, H, b, p.H_lines, p.b_lines,
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
        if p is not None:
            for i, line in enumerate(self._trusted):
                self._take_back(line, p, i, keyframes[-1])
        self.unit = _WORTH * max(mean_energy, _MIN_ENERGY)
        kept = [self._kept(line, keyframes[-1]) for line in self.lines]
        self.lines = [line for line in kept if line is not None]

    def _take_back(self, line: Line, p: _Packed, i: int, newest: Keyframe) -> None:
        line.point, line.direction = p.point[i].copy(), p.direction[i].copy()
        at = slice(p.start[i], p.start[i + 1])
        fits = off_px(p.m2[at], p.sigma[at]) < STRAY_PX
        if line.views[-1].keyframe is newest:
            line.failures = 0 if fits[-1] else line.failures + 1
        strays = [view for view, good in zip(line.held(), fits, strict=True) if not good]
        line.views = [view for view in line.views if view not in strays]

    def _kept(self, line: Line, newest: Keyframe) -> Line | None:
        """The line; or made anew from its first views where it failed too often; or none."""
        if len(line.views) < MIN_VIEWS:
            return None
        line.unseen = 0 if line.views[-1].keyframe is newest else line.unseen + 1
        if line.unseen > _MAX_UNSEEN:
            return None
        if line.failures < _MAX_FAILURES:
            return line
        again = None if line.retried else made(line.views[: MIN_VIEWS + 1], self.camera)
        if again is not None:
            again.retried = True
        return again
