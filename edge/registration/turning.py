# SPDX-License-Identifier: Apache-2.0
"""What turns on the spot cost: the scale, which only parallax hands on from old points to new."""

from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from edge.geometry import se3, so3
from edge.types import F64, DepthSamples, Mat4

# A turn by so much brings so many new points into view that the scale is theirs.
_VIEW_RAD = 0.5
# Over so much of the scene's depth, parallax tells their depths for sure; over less it is soon
# but noise and the bend of a rolling shutter (a robot's turn: scale off by a factor of 4).
_ENOUGH_SHARE = 0.03
# Variance of ln scale after a turn by one view without any parallax.
_VIEW_LOSS = 0.3
# Losses that are kept live: together they leave nothing of a scale from before.
KEPT_LIVE = 64


class Loss(NamedTuple):
    """The scale after the frame `number` is another than before, by so much."""

    number: int  # of the frame in the order of the drive
    position: F64  # (3,) of it [odometry units]
    variance: float  # of ln scale


class TurnLoss:
    """Follows one odometry frame, and tells what its turns have cost.

    A view is what is seen from one place and direction. It is left by a turn, which costs the
    more the less the camera has moved meanwhile, or by moving on, which costs nothing.
    """

    def __init__(self, kept: int | None = KEPT_LIVE) -> None:
        """`kept` losses at most; None keeps all."""
        self.losses: deque[Loss] = deque(maxlen=kept)
        self._now: Loss | None = None  # of the view that is not left yet
        self._T_odom_view: Mat4 | None = None
        self._moved = 0.0  # since the view began
        self._depth = float("nan")  # of the scene [odometry units]

    def look(self, depth: DepthSamples) -> None:
        """Take in how deep the scene is."""
        if len(depth.inverse_depth):
            self._depth = 1.0 / float(np.median(depth.inverse_depth))

    def add(self, number: int, T_odom_cam: Mat4) -> None:
        """Take in the next frame."""
        if self._T_odom_view is None or not self._depth > 0.0:
            self._begin(T_odom_cam)
            return
        T_view_cam = se3.inverse(self._T_odom_view) @ T_odom_cam
        self._moved = max(self._moved, float(np.linalg.norm(T_view_cam[:3, 3])) / self._depth)
        if self._moved >= 4.0 * _ENOUGH_SHARE:
            self._begin(T_odom_cam)
            return
        turned = min(so3.angle(T_view_cam[:3, :3]) / _VIEW_RAD, 1.0)
        # While half of the view's points are still seen, they hand its scale on.
        gone = max(2.0 * turned - 1.0, 0.0)
        loss = Loss(number, T_odom_cam[:3, 3], _VIEW_LOSS * gone * _doubt(self._moved))
        if turned >= 1.0:
            self.losses.append(loss)
            self._begin(T_odom_cam)
        else:
            self._now = loss

    def _begin(self, T_odom_cam: Mat4) -> None:
        self._T_odom_view, self._moved, self._now = T_odom_cam, 0.0, None

    def between(self, first: int, last: int) -> list[Loss]:
        """Losses after the frame of one number up to that of another, in either order."""
        first, last = min(first, last), max(first, last)
        now = () if self._now is None else (self._now,)
        return [loss for loss in (*self.losses, *now) if first < loss.number <= last]


def _doubt(moved: float) -> float:
    """Share of the scale's certainty that goes with a view left after moving so little."""
    return 1.0 if moved <= _ENOUGH_SHARE else (_ENOUGH_SHARE / moved) ** 4


def covariance(losses: Sequence[Loss], numbers: F64, number: int, offsets: F64) -> F64:
    """Covariance (7 n, 7 n) of what turns cost between one place and n others.

    numbers   (n,)       of the others' frames; that of the one place is `number`
    offsets   (n, m, 3)  their positions from those of the m losses, in map units and axes

    What lies beyond a loss, seen from the one place, is too large or too small by it.
    """
    n = len(numbers)
    at = np.array([loss.number for loss in losses])
    low, high = np.minimum(numbers, number), np.maximum(numbers, number)
    beyond = (low[:, None] < at) & (at <= high[:, None])
    columns = np.zeros((n, 7, len(losses)))
    columns[:, :3] = np.where(beyond[:, None], offsets.swapaxes(1, 2), 0.0)
    columns[:, 6] = beyond
    flat = columns.reshape(7 * n, -1) * np.sqrt([loss.variance for loss in losses])
    return np.asarray(flat @ flat.T)
