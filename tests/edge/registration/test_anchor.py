# SPDX-License-Identifier: Apache-2.0
import dataclasses
import math

import msgspec
import numpy as np
import pytest

from edge.config.registration import RegistrationConfig
from edge.geometry import se3, so3
from edge.registration import anchor as filters
from edge.registration.anchor import Anchor, pose_difference
from edge.registration.motion import Motion
from tests.edge.registration.simulated_drive import DEPTH_M, SimulatedDrive

CONFIG = RegistrationConfig()
STILL = msgspec.structs.replace(
    CONFIG, drift_position_depth_share=0.0, drift_rotation_rad=0.0, drift_log_scale=0.0
)
MOTION = Motion(se3.exp([0.6, -0.3, 0.9, 0.2, -0.4, 0.1]), 1.3, 0.5)


def started(**options: object) -> tuple[Anchor, SimulatedDrive]:
    drive = SimulatedDrive(60)
    return filters.start(drive.fix(0, **options), math.log(drive.scale), CONFIG), drive


def moved(anchor: Anchor, d: np.ndarray) -> Anchor:
    T = se3.from_rotation_translation(
        so3.exp(d[3:6]) @ anchor.T_map_cam[:3, :3], anchor.T_map_cam[:3, 3] + d[:3]
    )
    return dataclasses.replace(anchor, T_map_cam=T, log_scale=anchor.log_scale + d[6])


@pytest.mark.parametrize("axis", range(7), ids=["tx", "ty", "tz", "rx", "ry", "rz", "log s"])
def test_errors_are_carried_as_the_pose_itself_is(axis: int) -> None:
    anchor, _ = started()
    d = np.zeros(14)
    d[axis] = 1e-5
    anchor = dataclasses.replace(anchor, P=np.outer(d, d))
    after = filters.predict(anchor, MOTION, 9, STILL)
    ahead = filters.predict(moved(anchor, d), MOTION, 9, STILL)
    step = np.append(pose_difference(ahead.T_map_cam, after.T_map_cam), d[6])
    np.testing.assert_allclose(after.P[:7, :7], np.outer(step, step), atol=1e-14)


def test_two_short_ways_add_the_drift_of_one_long_way() -> None:
    anchor, _ = started()
    anchor = dataclasses.replace(anchor, P=np.zeros((14, 14)))
    straight = se3.exp([1.0, 0, 0, 0, 0, 0])
    half = Motion(se3.exp([0.5, 0, 0, 0, 0, 0]), 0.5, 0.0)
    once = filters.predict(anchor, Motion(straight, 1.0, 0.0), 2, CONFIG)
    twice = filters.predict(filters.predict(anchor, half, 1, CONFIG), half, 2, CONFIG)
    np.testing.assert_allclose(twice.P[:7, :7], once.P[:7, :7], rtol=1e-9, atol=1e-15)


def test_a_fix_too_far_ahead_makes_its_scale_too_small() -> None:
    """Position and scale share one error; only along the camera's axis."""
    anchor, drive = started()
    axis = drive.T_map_cam[0][:3, 2]
    shared = anchor.P[6, :3]
    assert shared @ axis < 0.0
    assert np.linalg.norm(shared - axis * (axis @ shared)) < 1e-2 * abs(shared @ axis)
    assert abs(shared @ axis) <= 0.004**2 / DEPTH_M + 1e-12


def test_many_fixes_from_one_place_never_look_better_than_their_common_error() -> None:
    anchor, drive = started()
    first = anchor.P[0, 0]
    for n in range(1, 200):
        fix = dataclasses.replace(drive.fix(0), index=n)
        still = Motion(np.eye(4), 0.0, 0.0)
        at = filters.predict(anchor, still, n, CONFIG)
        anchor = filters.update(at, fix, filters.compare(at, fix, CONFIG))
    assert CONFIG.common_share * first * 0.95 < anchor.P[0, 0] < 0.7 * first


@pytest.mark.parametrize(("drift", "low", "high"), [(0.0, 0.0, 0.25), (0.15, 0.3, 3.0)])
def test_drift_is_learnt_from_the_fixes(drift: float, low: float, high: float) -> None:
    factors = []
    for seed in range(6):
        drive = SimulatedDrive(400, drift=drift, seed=seed)
        anchor = filters.start(drive.fix(0, with_scale=False), math.log(drive.scale), CONFIG)
        for n in range(20, 400, 20):
            T = se3.inverse(drive.T_odom_cam[n - 20]) @ drive.T_odom_cam[n]
            path = sum(
                float(np.linalg.norm(b[:3, 3] - a[:3, 3]))
                for a, b in zip(
                    drive.T_odom_cam[n - 20 : n], drive.T_odom_cam[n - 19 :], strict=False
                )
            )
            at = filters.predict(anchor, Motion(T, path, so3.angle(T[:3, :3])), n, CONFIG)
            fix = drive.fix(n, with_scale=False)
            anchor = filters.update(at, fix, filters.compare(at, fix, CONFIG))
        factors.append(anchor.drift.variance_factor)
    assert low < np.median(factors) < high
