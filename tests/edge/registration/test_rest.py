# SPDX-License-Identifier: Apache-2.0
"""Poses from the map alone, of a camera at rest or all but."""

import dataclasses
import math
from collections.abc import Callable

import numpy as np

from edge.config.registration import RegistrationConfig
from edge.geometry import se3
from edge.registration.registration import Registration
from edge.types import (
    OdometryState,
    OdometryUpdate,
)
from tests.edge.registration.simulated_drive import (
    FRAME_NS,
    SimulatedDrive,
)

CONFIG = RegistrationConfig()


def test_a_camera_at_rest_gets_its_pose_from_the_map_alone() -> None:
    published, spread_m = 0, []
    for seed in range(6):
        drive, registration = SimulatedDrive(3, seed=seed), Registration(CONFIG)
        poses = []
        for n in range(25):
            t_ns = n * FRAME_NS
            poses.append(registration.step(OdometryUpdate(n, t_ns, OdometryState.WAITING, 1)))
            fix = drive.fix(0)
            fix = dataclasses.replace(fix, index=n, t_ns=t_ns, odom_id=None, T_odom_cam=None)
            if n % 3 == 0:
                registration.accept(fix)
        assert poses[5] is None
        places = [p.T_map_cam[:3, 3] for p in poses if p is not None]
        published += len(places)
        spread_m.append(0.0 if not places else np.ptp(places, axis=0).max())
    assert max(spread_m) < 0.015  # single fixes scatter by twice as much
    assert published > 30  # of 90 frames after the fixes that it takes


def test_a_moving_camera_without_odometry_gets_no_pose() -> None:
    drive, registration = SimulatedDrive(100), Registration(CONFIG)
    for n in range(100):
        update = OdometryUpdate(n, n * FRAME_NS, OdometryState.INITIALISING, 1)
        assert registration.step(update) is None
        if n % 3 == 0:
            fix = dataclasses.replace(drive.fix(n), odom_id=None, T_odom_cam=None)
            assert not registration.accept(fix).accepted


def slowly(registration: Registration, path_m: Callable[[float], float]) -> list[float]:
    """Play 2 s without odometry along the map's x by `path_m` of the time; errors of the poses."""
    drive, errors = SimulatedDrive(3), []
    for n in range(60):
        t_ns = n * FRAME_NS
        T = se3.exp([path_m(t_ns * 1e-9), 0.0, 0.0, 0.0, 0.0, 0.0]) @ drive.T_map_cam[0]
        pose = registration.step(OdometryUpdate(n, t_ns, OdometryState.INITIALISING, 1))
        if pose is not None:
            errors.append(float(np.linalg.norm(pose.T_map_cam[:3, 3] - T[:3, 3])))
        if n % 3 == 0:
            fix = drive.fix(0, noisy=False)
            registration.accept(
                dataclasses.replace(
                    fix, index=n, t_ns=t_ns, odom_id=None, T_odom_cam=None, T_map_cam=T
                )
            )
    return errors


def test_a_slow_and_even_motion_gets_its_pose_from_the_map_alone() -> None:
    errors = slowly(Registration(CONFIG), lambda t_s: 0.12 * t_s)
    assert len(errors) > 40
    assert max(errors) < 0.002


def test_a_fast_or_uneven_motion_gets_none() -> None:
    assert not slowly(Registration(CONFIG), lambda t_s: 0.4 * t_s)
    assert not slowly(Registration(CONFIG), lambda t_s: 0.04 * math.sin(8.0 * t_s))
