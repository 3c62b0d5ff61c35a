# SPDX-License-Identifier: Apache-2.0
"""What is told to the outside: map poses that are certain enough, exact and smooth."""

import math
from typing import NamedTuple

import numpy as np

from edge.config.registration import RegistrationConfig
from edge.geometry import se3
from edge.geometry.covariance import position_sigma, rotation_sigma
from edge.registration.constellation import Estimate
from edge.registration.motion import TrackedFrame
from edge.registration.smooth import SmoothStream
from edge.types import MapPose, Mat4, Mat6, OdometryUpdate


class _Published(NamedTuple):
    """The last published pose and what it was made from."""

    pose: MapPose
    frame: TrackedFrame | None  # None: at rest, without odometry
    depth_m: float


class Publisher:
    """Owns the smooth stream and the last known place. Owned by the tracking thread."""

    def __init__(self, config: RegistrationConfig) -> None:
        self._config = config
        self._smooth = SmoothStream(config)
        self._last: _Published | None = None

    def interrupt(self) -> None:
        """The stream has a gap, or begins anew elsewhere."""
        self._smooth.interrupt()

    def is_in_doubt(self, estimate: Estimate) -> bool:
        """Whether fixes must agree anew; what is not a number is a doubt."""
        sigma_share = position_sigma(estimate.covariance) / estimate.depth_m
        fits = sigma_share <= self._config.doubt_sigma_depth_share
        return not (fits and rotation_sigma(estimate.covariance) < math.inf)

    def is_certain(self, estimate: Estimate) -> bool:
        """Whether a pose is good enough to be told."""
        sigma_share = position_sigma(estimate.covariance) / estimate.depth_m
        if not sigma_share <= self._config.publish_sigma_depth_share:
            return False
        sigma_rad = rotation_sigma(estimate.covariance)
        return sigma_rad <= math.radians(self._config.publish_sigma_deg)

    def tracked(self, update: OdometryUpdate, frame: TrackedFrame, estimate: Estimate) -> MapPose:
        """Pose of a tracked frame."""
        covariance = estimate.covariance + self._tracking_noise(frame, estimate)
        step = self._step_since_last(frame, estimate)
        pose = self._publish(update, estimate.T_map_cam, covariance, step, estimate.scale)
        self._last = _Published(pose, frame, estimate.depth_m)
        return pose

    def at_rest(
        self, update: OdometryUpdate, T_map_cam: Mat4, covariance: Mat6, depth_m: float
    ) -> MapPose:
        """Pose from the map alone, without odometry."""
        still = self._last is None or self._last.frame is None
        step = np.eye(4) if still else None
        pose = self._publish(update, T_map_cam, covariance, step, math.nan)
        self._last = _Published(pose, None, depth_m)
        return pose

    def last_place(self, t_ns: int) -> tuple[Mat4, Mat6] | None:
        """The last known place, with a sigma that grows with time; None after too long."""
        if self._last is None:
            return None
        age_s = abs(t_ns - self._last.pose.t_ns) * 1e-9  # time falls in a reversed replay
        if age_s > self._config.last_place_s:
            return None
        sigma = self._config.last_place_depths_per_s * age_s
        growth = np.repeat(((sigma * self._last.depth_m) ** 2, sigma**2), 3)
        return self._last.pose.T_map_cam, self._last.pose.covariance + np.diag(growth)

    def _tracking_noise(self, frame: TrackedFrame, estimate: Estimate) -> Mat6:
        """What a single frame errs by: an image that bends the way bends the frame as well.

        Rows that a turn has shifted look like a motion aside, of all that is at some depth.
        """
        config, drift = self._config, estimate.drift
        rows = config.tracking_rows_share * frame.rows_rad
        turn = math.hypot(config.tracking_rotation_rad * drift.bend, rows)
        shift = math.hypot(config.tracking_depth_share * drift.shift, rows) * estimate.depth_m
        return np.diag(np.repeat((shift**2, turn**2), 3))

    def _step_since_last(self, frame: TrackedFrame, estimate: Estimate) -> Mat4 | None:
        """Motion in map units since the last published pose, if the same odometry links them."""
        last = None if self._last is None else self._last.frame
        if last is None or last.odom_id != frame.odom_id:
            return None
        T_step = se3.inverse(last.T_odom_cam) @ frame.T_odom_cam
        T_step[:3, 3] *= estimate.scale
        return T_step

    def _publish(
        self,
        update: OdometryUpdate,
        T_map_cam: Mat4,
        covariance: Mat6,
        T_step: Mat4 | None,
        scale: float,
    ) -> MapPose:
        T_smooth = self._smooth.step(T_map_cam, T_step)
        for array in (T_map_cam, T_smooth, covariance):
            array.flags.writeable = False
        return MapPose(
            update.index,
            update.t_ns,
            T_map_cam,
            T_smooth,
            covariance,
            scale,
            self._smooth.reset_counter,
        )
