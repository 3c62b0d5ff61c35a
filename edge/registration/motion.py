# SPDX-License-Identifier: Apache-2.0
"""What the odometry says lies between two of its frames, and the frames that it has seen."""

from collections import OrderedDict
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from edge.geometry import se3, so3
from edge.registration.turning import TurnLoss
from edge.types import KeyframeResult, Mat4, OdometryUpdate


class Motion(NamedTuple):
    """The way from one frame to a later one, in odometry units."""

    T_from_to: Mat4  # takes points of the later camera to the earlier one
    path: float  # length of the way, not of the displacement
    turn_rad: float  # sum of all rotations on the way


@dataclass(frozen=True, slots=True, eq=False)
class TrackedFrame:
    """One tracked frame as it was known live, and its place on the way."""

    odom_id: int
    index: int
    number: int  # how many came before it; indices fall when a recording runs in reverse
    T_odom_cam: Mat4
    reference_index: int | None
    T_reference_cam: Mat4 | None
    path: float  # from the first frame of this odometry [odometry units]
    turn_rad: float
    rows_rad: float = 0.0  # turn while a rolling shutter read the rows, as far as is known


class OdometryTrack:
    """The tracked frames of one odometry frame; poses follow their keyframe's refinement."""

    def __init__(self, odom_id: int, capacity: int) -> None:
        self.odom_id = odom_id
        self._capacity = capacity
        self._frames: OrderedDict[int, TrackedFrame] = OrderedDict()
        self._keyframes: OrderedDict[int | None, Mat4] = OrderedDict()
        self._window: frozenset[int] = frozenset()
        self._last: TrackedFrame | None = None
        self._last_t_ns: int | None = None
        self._readout_s = 0.0
        self.turns = TurnLoss()
        self.revision = 0  # grows with each refinement of the keyframes
        # The frame with the depths that the map told, if it started from such.
        self.founder: int | None = None

    def add(self, update: OdometryUpdate) -> TrackedFrame | None:
        """Take in what `update` says; return its frame, if it was tracked."""
        if update.keyframe is not None:
            self._refine(update.keyframe)
            self._readout_s = abs(update.keyframe.readout_s)
            self.turns.look(update.keyframe.depth)
            self._meet(update.odom_id, update.keyframe)
        if update.T_odom_cam is None:
            return None
        frame = self._placed(
            update.odom_id,
            update.index,
            update.T_odom_cam,
            update.reference_index,
            update.T_reference_cam,
        )
        frame = replace(frame, rows_rad=self._rows_rad(frame, update.t_ns))
        self._remember(frame)
        self._last_t_ns = update.t_ns
        return frame

    def _rows_rad(self, frame: TrackedFrame, t_ns: int) -> float:
        """How far the camera turned since the last frame, for the time that rows take."""
        if self._last is None or self._last_t_ns in (None, t_ns):
            return 0.0
        turned = frame.turn_rad - self._last.turn_rad
        return turned * self._readout_s / (abs(t_ns - self._last_t_ns) * 1e-9)

    def holds(self, index: int) -> bool:
        """Whether the frame `index` was tracked and is still known."""
        return index in self._frames

    def is_later(self, index: int, other: int) -> bool:
        """Whether the known frame `index` was tracked after the known frame `other`."""
        return self._frames[index].number > self._frames[other].number

    def frame(self, index: int) -> TrackedFrame:
        """Return the known frame `index`."""
        return self._frames[index]

    def in_window(self, index: int) -> bool:
        """Whether the frame `index` is a keyframe that the odometry still refines."""
        return index in self._window

    def pose(self, index: int) -> Mat4:
        """T_odom_cam of the frame `index`, by what is known of its keyframe now."""
        return self.place(self._frames[index])

    def place(self, frame: TrackedFrame) -> Mat4:
        """T_odom_cam of a frame that was tracked here, known still or not."""
        own = self._keyframes.get(frame.index)
        if own is not None:
            return own
        keyframe = self._keyframes.get(frame.reference_index)
        if keyframe is None or frame.T_reference_cam is None:
            return frame.T_odom_cam
        return keyframe @ frame.T_reference_cam

    def between(self, earlier: int, later: int) -> Motion:
        """Return the motion between two known frames."""
        a, b = self._frames[earlier], self._frames[later]
        T_from_to = se3.inverse(self.pose(earlier)) @ self.pose(later)
        return Motion(T_from_to, abs(b.path - a.path), abs(b.turn_rad - a.turn_rad))

    def _meet(self, odom_id: int, result: KeyframeResult) -> None:
        """Remember the keyframes of the start, which were not tracked when they came."""
        if self._last is not None:
            return
        self.founder = result.frame.index if result.in_map_units else None
        for keyframe in result.window:
            T, index = keyframe.T_odom_cam, keyframe.index
            self._remember(self._placed(odom_id, index, T, index, np.eye(4)))
        for pose in result.followed:
            T_keyframe_cam = se3.inverse(result.T_odom_cam) @ pose.T_odom_cam
            reference = result.frame.index
            self._remember(
                self._placed(odom_id, pose.index, pose.T_odom_cam, reference, T_keyframe_cam)
            )

    def _remember(self, frame: TrackedFrame) -> None:
        self.turns.add(frame.number, frame.T_odom_cam)
        self._frames[frame.index] = self._last = frame
        while len(self._frames) > self._capacity:
            self._frames.popitem(last=False)

    def _placed(
        self,
        odom_id: int,
        index: int,
        T_odom_cam: Mat4,
        reference_index: int | None,
        T_reference_cam: Mat4 | None,
    ) -> TrackedFrame:
        number, path, turn = 0, 0.0, 0.0
        if self._last is not None:
            step = se3.inverse(self._last.T_odom_cam) @ T_odom_cam
            number = self._last.number + 1
            path = self._last.path + float(np.linalg.norm(step[:3, 3]))
            turn = self._last.turn_rad + so3.angle(step[:3, :3])
        return TrackedFrame(
            odom_id, index, number, T_odom_cam, reference_index, T_reference_cam, path, turn
        )

    def _refine(self, result: KeyframeResult) -> None:
        self.revision += 1
        self._window = frozenset(keyframe.index for keyframe in result.window)
        for keyframe in result.window:
            self._keyframes[keyframe.index] = keyframe.T_odom_cam
            self._keyframes.move_to_end(keyframe.index)
        while len(self._keyframes) > self._capacity:
            self._keyframes.popitem(last=False)
