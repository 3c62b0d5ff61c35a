# SPDX-License-Identifier: Apache-2.0
"""A drive through the corner, and what every update of it must keep to."""

from collections.abc import Iterable
from functools import cache

import numpy as np

from edge.config.odometry import OdometryConfig
from edge.geometry.camera import CameraModel
from edge.odometry.odometry import Odometry
from edge.types import Frame, OdometryState, OdometryUpdate
from tests.edge.odometry.scenes import (
    MIDDLE,
    Corner,
    centres,
    frames_along,
    rmse_after_similarity,
    wandering,
)

N_DRIVE = 110
SETTLED = 30  # by then the drive is tracked for long
CORNER = Corner(1)


@cache
def drive() -> tuple[Frame, ...]:
    return tuple(frames_along(CORNER, MIDDLE, wandering(N_DRIVE)))


def play(
    frames: Iterable[Frame], config: OdometryConfig | None = None, camera: CameraModel = MIDDLE
) -> list[OdometryUpdate]:
    odometry = Odometry(camera, config)
    return [odometry.step(frame) for frame in frames]


@cache
def normal_run() -> tuple[OdometryUpdate, ...]:
    return tuple(play(drive()))


def tracked(updates: Iterable[OdometryUpdate]) -> list[OdometryUpdate]:
    return [u for u in updates if u.T_odom_cam is not None]


def error_m(updates: Iterable[OdometryUpdate]) -> float:
    """RMSE of the tracked frames' positions after the best similarity."""
    poses, found = wandering(N_DRIVE), tracked(updates)
    return rmse_after_similarity(
        centres([u.T_odom_cam for u in found]), centres([poses[u.index] for u in found])
    )


def check_border(update: OdometryUpdate) -> None:
    """What holds of every update, whatever was seen."""
    has_pose = update.state is OdometryState.TRACKING and update.T_odom_cam is not None
    assert has_pose == (update.T_odom_cam is not None)
    assert 0.0 <= update.quality <= 1.0
    if has_pose:
        assert np.all(np.isfinite(update.T_odom_cam))
        assert np.all(np.isfinite(update.covariance))
        R = update.T_odom_cam[:3, :3]
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-9)
    if update.keyframe is not None:
        depth = update.keyframe.depth
        assert len(depth.pixels) == len(depth.inverse_depth) == len(depth.sigma)
        assert np.all(np.isfinite(depth.pixels))
        assert np.all(depth.inverse_depth > 0)
        assert np.all(np.isfinite(depth.sigma))
        assert np.all(depth.sigma > 0)
        assert all(np.all(np.isfinite(k.T_odom_cam)) for k in update.keyframe.window)
