# SPDX-License-Identifier: Apache-2.0
"""What the tracking thread remembers of the last tracked frame."""

from dataclasses import dataclass

import numpy as np

from edge.geometry import se3
from edge.odometry.map_start import FIRST_RESIDUAL_GREY
from edge.odometry.mapper import MappedKeyframe
from edge.odometry.reference import Reference
from edge.odometry.tracker import Tracked
from edge.types import F64, Frame, Mat4

# No camera is further from where its motion led between two frames, in depths of what it sees:
# where the tracking says so, it has slipped.
MAX_LEAP_DEPTHS = 0.2


@dataclass(slots=True, eq=False)
class LastMotion:
    """Where the camera was, how it moved, and how well its image agreed."""

    T_odom_cam: Mat4
    T_cam_last: Mat4  # motion expected over the next `gap` frames
    affine: F64
    residual_grey: float
    gap: int = 1  # frames from the last tracked one to the next
    failures: int = 0
    t_ns: int | None = None  # of the last tracked frame

    @classmethod
    def after_start(cls, mapped: MappedKeyframe, frame: Frame, gap: int) -> "LastMotion":
        """What a start says of the motion up to `frame`, `gap` frames after its last one."""
        if (ahead := mapped.ahead) is not None:
            step = se3.exp(gap * se3.log(ahead.T_cam_last))
            return cls(ahead.T_odom_cam, step, ahead.affine, ahead.residual_grey, gap)
        window, step = mapped.result.window, np.eye(4)
        if len(window) > 1:
            # The motion between the start's keyframes went on while it was worked on.
            since = abs(frame.index - window[-1].index)
            apart = max(abs(window[-1].index - window[-2].index), 1)
            step = se3.inverse(window[-1].T_odom_cam) @ window[-2].T_odom_cam
            step = se3.exp(se3.log(step) * since / apart)
        reference = mapped.reference
        return cls(reference.T_odom_cam, step, reference.affine, FIRST_RESIDUAL_GREY, gap)

    def leaps(self, tracked: Tracked, reference: Reference) -> bool:
        """Whether the camera cannot have come there since the last frame."""
        T_odom_cam = reference.T_odom_cam @ se3.inverse(tracked.T_cam_reference)
        expected = self.T_odom_cam @ se3.inverse(self.T_cam_last)
        leap = float(np.linalg.norm(T_odom_cam[:3, 3] - expected[:3, 3]))
        return leap * reference.inverse_depth > MAX_LEAP_DEPTHS * min(self.gap, 2)

    def remember(self, T_odom_cam: Mat4, tracked: Tracked, t_ns: int) -> None:
        """Take over a newly tracked frame."""
        step = se3.inverse(T_odom_cam) @ self.T_odom_cam
        if self.gap > 1:
            step = se3.exp(se3.log(step) / self.gap)
        self.T_odom_cam, self.T_cam_last = T_odom_cam, step
        self.affine, self.gap, self.failures = tracked.affine, 1, 0
        self.t_ns = t_ns
        # Follows slowly: what is normal depends on texture and blur.
        self.residual_grey = max(2.0, 0.7 * self.residual_grey + 0.3 * tracked.residual_grey)
