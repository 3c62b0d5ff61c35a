# SPDX-License-Identifier: Apache-2.0
"""How fast the camera moves while its rows are read."""

from typing import NamedTuple

from edge.geometry import se3, so3
from edge.image.pyramid import STILL
from edge.odometry.starter import Start
from edge.types import F64, Mat4

# A hand's motion is another after this time.
MAX_INTERVAL_NS = 200_000_000


class Rates(NamedTuple):
    """How a camera moves, in its own axes."""

    turning: F64  # (3,) angular rate [rad/s]
    velocity: F64  # (3,) how a still point's coordinates change by translation [1/s]


STANDING = Rates(STILL, STILL)


def rates(T_new_old: Mat4, interval_ns: int) -> Rates:
    """Rates over the motion T_new_old; none where it took no time or too long to be even."""
    if not 0 < abs(interval_ns) <= MAX_INTERVAL_NS:
        return STANDING
    interval_s = interval_ns * 1e-9
    return Rates(-so3.log(T_new_old[:3, :3]) / interval_s, T_new_old[:3, 3] / interval_s)


class PathPose(NamedTuple):
    """Where the camera was."""

    t_ns: int
    T_cam_odom: Mat4

    def motion_to(self, other: "PathPose") -> Rates:
        """Mean rates from here to there."""
        return rates(other.T_cam_odom @ se3.inverse(self.T_cam_odom), other.t_ns - self.t_ns)


def start_motions(start: Start) -> list[Rates]:
    """How the camera moved at the start's frames, each between its neighbours."""
    path = [
        PathPose(frame.t_ns, T)
        for frame, T in zip(start.frames, start.T_cam_reference, strict=True)
    ]
    last = len(path) - 1
    return [path[max(i - 1, 0)].motion_to(path[min(i + 1, last)]) for i in range(last + 1)]
