# SPDX-License-Identifier: Apache-2.0
"""What an autopilot is told, and in which messages: the presets `px4` and `ardupilot`."""

import math

import numpy as np

from edge.config.serial import SerialConfig
from edge.geometry import so3
from edge.outputs import mavlink
from edge.outputs.frames import BodyPose, quality_percent
from edge.outputs.serial_stream import LinkStatus
from edge.types import F64, Mat6

_UPPER = np.triu_indices(6)


class Autopilot:
    """Poses, a heartbeat and a word to the operator, as MAVLink 2.

    Owned by one thread.
    """

    def __init__(self, config: SerialConfig) -> None:
        self._encoder = mavlink.Encoder(config.system_id, config.component_id)
        self._with_odometry = config.preset == "px4"
        known = config.map_heading_deg is not None
        self._frame_id = mavlink.FRAME_LOCAL_NED if known else mavlink.FRAME_LOCAL_FRD
        self._told: bool | None = None

    def pose(self, body: BodyPose, quality: float, age_ns: int) -> bytes:
        """ODOMETRY for PX4, VISION_POSITION_ESTIMATE for ArduPilot; the time says the age."""
        R = body.T_world_body[:3, :3]
        position = body.T_world_body[:3, 3]
        covariance = body.covariance[_UPPER]
        if not self._with_odometry:
            return self._encoder.vision_position_estimate(
                mavlink.VisionPositionEstimate(
                    body.t_ns // 1000,
                    position,
                    _roll_pitch_yaw(R),
                    covariance,
                    body.reset_counter & 0xFF,
                )
            )
        return self._encoder.odometry(
            mavlink.Odometry(
                body.t_ns // 1000,
                self._frame_id,
                position,
                np.roll(so3.to_quaternion_xyzw(R), 1),
                body.linear_m_s,
                body.angular_rad_s,
                covariance,
                _upper(body.velocity_covariance),
                body.reset_counter & 0xFF,
                quality_percent(quality),
            )
        )

    def status(self, status: LinkStatus) -> bytes:
        """A heartbeat; and once after each change, whether poses come."""
        state = mavlink.STATE_ACTIVE if status.localised else mavlink.STATE_STANDBY
        message = self._encoder.heartbeat(state)
        if status.localised is not self._told:
            first, self._told = self._told is None, status.localised
            message += self._notice(first=first)
        return message

    def notice(self, text: str) -> bytes:
        """STATUSTEXT; what is longer than it holds is cut."""
        return self._encoder.statustext(mavlink.SEVERITY_NOTICE, f"mapvo: {text}")

    def _notice(self, *, first: bool) -> bytes:
        if self._told:
            return self._encoder.statustext(mavlink.SEVERITY_INFO, "mapvo: localised")
        if first:
            return self._encoder.statustext(mavlink.SEVERITY_INFO, "mapvo: not yet localised")
        return self._encoder.statustext(mavlink.SEVERITY_WARNING, "mapvo: lost, no poses")


def _upper(covariance: Mat6) -> F64:
    """21 upper terms; NaN in the first alone says by the standard that all are unknown."""
    upper = covariance[_UPPER]
    if np.all(np.isfinite(upper)):
        return upper
    return np.concatenate(([np.nan], np.zeros(20)))


def _roll_pitch_yaw(R: F64) -> F64:
    """Angles (3,) [rad] with R = Rz(yaw) Ry(pitch) Rx(roll); yaw 0 where the nose is upright."""
    pitch = math.asin(min(max(-R[2, 0], -1.0), 1.0))
    if abs(R[2, 0]) > 1.0 - 1e-12:
        return np.array([math.atan2(-R[1, 2], R[1, 1]), pitch, 0.0])
    return np.array([math.atan2(R[2, 1], R[2, 2]), pitch, math.atan2(R[1, 0], R[0, 0])])
