# SPDX-License-Identifier: Apache-2.0
"""How fast the camera moves, from the odometry's last poses.

The odometry's poses are continuous; those in the map also hold corrections,
which are no motion.
"""

from collections import deque
from typing import NamedTuple

import numpy as np

from edge.geometry import so3
from edge.types import F64, MapPose, Mat4, Mat6, OdometryUpdate

_WINDOW_NS = 150_000_000  # of 5 frames at 30 Hz; longer, and the answer is of the past
_MIN_POSES = 4  # a line through 3 says little about its own error
# What the motion may have changed by since the middle of the window: a brisk indoor robot.
_MAX_ACCELERATION_M_S2 = 2.0
_MAX_ANGULAR_ACCELERATION_RAD_S2 = 4.0


class Velocity(NamedTuple):
    """The camera's, in the map's axes."""

    linear_m_s: F64  # (3,)
    angular_rad_s: F64  # (3,)
    covariance: Mat6  # (6, 6) linear, then angular


def moved(T_map_cam: Mat4, velocity: Velocity, seconds: float) -> Mat4:
    """Where the camera is so much later if it goes on as it does."""
    T = np.array(T_map_cam)
    T[:3, 3] += seconds * velocity.linear_m_s
    T[:3, :3] = so3.exp(seconds * velocity.angular_rad_s) @ T[:3, :3]
    return T


class MotionEstimator:
    """Fits a straight line to the last poses of one odometry frame.

    Owned by one thread.
    """

    def __init__(self) -> None:
        self._odom_id = 0
        self._poses: deque[tuple[int, Mat4]] = deque()

    def step(self, update: OdometryUpdate, pose: MapPose | None) -> Velocity | None:
        """Velocity at `update`; None while there is too little to tell it from.

        Call it for each frame, with or without a map pose.
        """
        if update.T_odom_cam is None or update.odom_id != self._odom_id:
            self._poses.clear()
        if update.T_odom_cam is None:
            return None
        self._odom_id = update.odom_id
        self._poses.append((update.t_ns, update.T_odom_cam))
        while update.t_ns - self._poses[0][0] > _WINDOW_NS or self._poses[0][0] > update.t_ns:
            self._poses.popleft()
        if pose is None or not np.isfinite(pose.scale) or len(self._poses) < _MIN_POSES:
            return None
        return self._fit(update.T_odom_cam, pose)

    def _fit(self, T_odom_cam: Mat4, pose: MapPose) -> Velocity | None:
        """Slopes of position and rotation over time, turned into the map's axes."""
        seconds = np.array([(t_ns - self._poses[-1][0]) * 1e-9 for t_ns, _ in self._poses])
        mean_s = float(seconds.mean())
        spread = float(np.sum((seconds - mean_s) ** 2))
        if spread <= 0.0:
            return None
        R = T_odom_cam[:3, :3]
        path = np.array(
            [
                np.concatenate((pose.scale * T[:3, 3], so3.log(T[:3, :3] @ R.T)))
                for _, T in self._poses
            ]
        )
        centred = path - path.mean(axis=0)
        slope = (seconds - mean_s) @ centred / spread
        residuals = centred - np.outer(seconds - mean_s, slope)
        variance = np.sum(residuals**2, axis=0) / (len(seconds) - 2) / spread
        # One sigma for each of the two vectors: a single axis has too few residuals.
        drift = np.array([_MAX_ACCELERATION_M_S2, _MAX_ANGULAR_ACCELERATION_RAD_S2]) * mean_s
        variances = variance.reshape(2, 3).mean(axis=1) + drift**2
        R_map_odom = pose.T_map_cam[:3, :3] @ R.T
        return Velocity(
            R_map_odom @ slope[:3], R_map_odom @ slope[3:], np.diag(np.repeat(variances, 3))
        )
