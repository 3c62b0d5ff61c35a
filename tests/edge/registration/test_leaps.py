# SPDX-License-Identifier: Apache-2.0
"""An odometry that is dragged along by a shade, or by rows that turn."""

import dataclasses

import numpy as np
import pytest

from edge.config.registration import RegistrationConfig
from edge.geometry import se3
from edge.registration.registration import Registration
from tests.edge.registration.simulated_drive import SimulatedDrive, error_m, play

LEAP = 70


def dragged(aside_m: float) -> SimulatedDrive:
    """A drive whose odometry steps aside in one frame, and stays there."""
    drive = SimulatedDrive(130)
    T_drag = np.eye(4)
    T_drag[0, 3] = aside_m / drive.scale
    drive.T_odom_cam[LEAP:] = [T_drag @ T for T in drive.T_odom_cam[LEAP:]]
    return drive


@pytest.mark.parametrize("aside_m", [0.1, -0.4])
def test_after_a_leap_nothing_is_told_until_a_fix_since_then_fits(aside_m: float) -> None:
    drive, registration = dragged(aside_m), Registration(RegistrationConfig())
    play(drive, registration, range(LEAP))
    told = {}
    for n in range(LEAP, 120):
        pose = registration.step(drive.update(n))
        if pose is not None:
            told[n] = error_m(drive, pose)
        if n % 6 == 0:
            # Late: the first is of a frame before the leap, and fits.
            registration.accept(drive.fix(n - 4))
    assert min(told) > LEAP + 6
    assert len(told) > 15
    assert max(told.values()) < 0.05


def test_a_hand_that_trembles_does_not_leap() -> None:
    drive, registration = SimulatedDrive(200), Registration(RegistrationConfig())
    play(drive, registration, range(50))
    rng = np.random.default_rng(0)
    for n in range(50, 150):
        update = drive.update(n)
        assert update.T_odom_cam is not None
        shake = se3.exp(np.append(0.003 / drive.scale * rng.normal(size=3), np.zeros(3)))
        pose = registration.step(dataclasses.replace(update, T_odom_cam=shake @ update.T_odom_cam))
        assert pose is not None
        if n % 6 == 0:
            registration.accept(drive.fix(n))
