# SPDX-License-Identifier: Apache-2.0
"""The camera's pose in the map as a vehicle wants it: its body, in a level frame.

- map: as it was built
- level: the map levelled, z up (manifest `T_local_map`)
- frd: level, x as there, y to the right of it, z down; `ned` where x is north
- body: the vehicle, x forward, y right, z down (`T_body_cam` of the configuration)
"""

import math
from typing import NamedTuple

import numpy as np

from edge.errors import ConfigError
from edge.geometry import se3, so3
from edge.outputs.motion import Velocity
from edge.types import F64, MapPose, Mat4, Mat6

_FRD_LEVEL = np.diag([1.0, -1.0, -1.0])


class BodyPose(NamedTuple):
    """The body in the world frame (frd, ned, level or map), and how it moves.

    Covariances are (6, 6): position [m^2], then rotation [rad^2] in the world's axes; linear
    [m^2/s^2], then angular [rad^2/s^2] in the body's axes.
    """

    t_ns: int
    T_world_body: Mat4
    covariance: Mat6
    linear_m_s: F64  # (3,) of the body's origin, in the body's axes; NaN where unknown
    angular_rad_s: F64  # (3,) in the body's axes; NaN where unknown
    velocity_covariance: Mat6  # NaN where unknown
    reset_counter: int


class BodyFrames:
    """Turns poses of the camera in the map into poses of the body in the world."""

    def __init__(self, T_body_cam: Mat4, T_world_map: Mat4) -> None:
        self._T_cam_body = se3.inverse(se3.normalise(T_body_cam))
        self._T_world_map = T_world_map

    def convert(self, pose: MapPose, velocity: Velocity | None) -> BodyPose:
        """The body's pose from the smooth stream: that is what one may steer by."""
        T_world_cam = self._T_world_map @ pose.T_map_cam_smooth
        T_world_body = T_world_cam @ self._T_cam_body
        R_world_map = self._T_world_map[:3, :3]
        lever = T_world_body[:3, 3] - T_world_cam[:3, 3]
        covariance = _rotate(_smooth_covariance(pose), R_world_map)
        linear, angular = np.full(3, np.nan), np.full(3, np.nan)
        velocity_covariance = np.full((6, 6), np.nan)
        if velocity is not None:
            R_body_world = T_world_body[:3, :3].T
            turn = R_world_map @ velocity.angular_rad_s
            push = R_world_map @ velocity.linear_m_s + np.cross(turn, lever)
            linear, angular = R_body_world @ push, R_body_world @ turn
            in_world = _move(_rotate(velocity.covariance, R_world_map), lever)
            velocity_covariance = _rotate(in_world, R_body_world)
        return BodyPose(
            pose.t_ns,
            T_world_body,
            _move(covariance, lever),
            linear,
            angular,
            velocity_covariance,
            pose.reset_counter,
        )


def frd_from_level(heading_rad: float | None) -> Mat4:
    """Transform (4, 4) of the level frame to FRD, or to NED where the heading of its x is known."""
    R = _FRD_LEVEL if heading_rad is None else so3.exp([0.0, 0.0, heading_rad]) @ _FRD_LEVEL
    return se3.from_rotation_translation(R, np.zeros(3))


def require_level_metres(
    *, metric: bool, T_local_map: list[list[float]] | None, map_name: str
) -> Mat4:
    """`T_local_map` (4, 4) of a map that an autopilot may fly by; ConfigError says what mends it.

    `metric` and `T_local_map` are those of the map's manifest.
    """
    if not metric:
        raise ConfigError(
            f"{map_name}: has no metric scale, which MAVLink promises: "
            f"run `mapvo-map align {map_name} --points FILE` with surveyed points, or build it "
            "from metric poses"
        )
    if T_local_map is None:
        raise ConfigError(
            f"{map_name}: is not level, which MAVLink's frames are: "
            f"run `mapvo-map align {map_name} --up X,Y,Z` with the map's upward direction"
        )
    return np.array(T_local_map, np.float64)


def quality_percent(quality: float) -> int:
    """0 to 100 of a quality of 0 to 1."""
    return round(100.0 * min(max(quality, 0.0), 1.0)) if math.isfinite(quality) else 0


def _smooth_covariance(pose: MapPose) -> Mat6:
    """Covariance of the smooth pose: that of the exact one, and what still parts the two."""
    exact, smooth = pose.T_map_cam, pose.T_map_cam_smooth
    apart = np.concatenate(
        (smooth[:3, 3] - exact[:3, 3], so3.log(smooth[:3, :3] @ exact[:3, :3].T))
    )
    return np.asarray(pose.covariance + np.outer(apart, apart), np.float64)


def _rotate(covariance: Mat6, R: F64) -> Mat6:
    """Covariance (6, 6) of two vectors in the axes that R takes them to."""
    J = np.kron(np.eye(2), R)
    return np.asarray(J @ covariance @ J.T, np.float64)


def _move(covariance: Mat6, lever: F64) -> Mat6:
    """Covariance (6, 6) of a point that lies `lever` (3,) from the one that it is known for."""
    J = np.eye(6)
    J[:3, 3:] = -so3.hat(lever)
    return np.asarray(J @ covariance @ J.T, np.float64)
