# SPDX-License-Identifier: Apache-2.0
"""Frames at which the odometry has leapt: its camera would have needed to be thrown.

A shade that sweeps through the image, or rows that turn, drag the tracking along, and it is as sure
of that as ever: poses were 20 cm to 3 m off at a sigma of 1 cm until the next fix spoke. But no
hand and no robot changes its speed so much within a frame.
"""

from collections import deque

import numpy as np

from edge.geometry import se3
from edge.registration.motion import TrackedFrame
from edge.types import F64, Mat4

# Of the scene's depth: less is no leap. On eleven good drives steps changed by up to 0.024.
_LEAST_SHARE = 0.03
# So many times what steps usually change by, once so many are known.
_TIMES_USUAL = 8.0
_KEPT, _ENOUGH = 60, 15
_UNEVEN = 1.5  # frames so unevenly apart in time have steps that cannot be compared


class Leaps:
    """Follows one odometry frame, and tells whether it has leapt. All lengths in its units."""

    def __init__(self) -> None:
        self._leapt: int | None = None  # the number of the last frame that it leapt to
        self._changes: deque[float] = deque(maxlen=_KEPT)
        self._last: tuple[int, Mat4] | None = None
        self._before: tuple[int, F64] | None = None  # the last time between frames, and step

    @property
    def unsettled(self) -> bool:
        """Whether no fix has told yet where the last leap led to."""
        return self._leapt is not None

    def settle(self, number: int) -> None:
        """A fix of that frame fits: from there on it is known where the camera is."""
        if self._leapt is not None and number >= self._leapt:
            self._leapt = None

    def add(self, t_ns: int, frame: TrackedFrame, depth: float) -> None:
        """Take in the next frame, before a scene of a certain depth."""
        if self._is_leap(t_ns, frame.T_odom_cam, depth):
            self._leapt = frame.number

    def _is_leap(self, t_ns: int, T_odom_cam: Mat4, depth: float) -> bool:
        last, before = self._last, self._before
        self._last = t_ns, T_odom_cam
        if last is None or last[0] == t_ns:
            return False
        apart_ns, step = t_ns - last[0], (se3.inverse(last[1]) @ T_odom_cam)[:3, 3]
        self._before = apart_ns, step
        if before is None or not 1.0 / _UNEVEN < apart_ns / before[0] < _UNEVEN:
            return False
        change = float(np.linalg.norm(step - before[1] * (apart_ns / before[0])))
        usual = float(np.median(self._changes)) if len(self._changes) >= _ENOUGH else 0.0
        self._changes.append(change)
        return change > max(_LEAST_SHARE * depth, _TIMES_USUAL * usual)
