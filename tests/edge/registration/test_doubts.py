# SPDX-License-Identifier: Apache-2.0
"""Fixes that are refused, and still say that the odometry is somewhere else."""

import dataclasses

import numpy as np
import pytest

from edge.config.registration import RegistrationConfig
from edge.geometry import se3
from edge.registration.registration import Registration
from edge.types import Fix, Mat4, OdometryState, OdometryUpdate
from tests.edge.registration.simulated_drive import SimulatedDrive, play

CONFIG = RegistrationConfig()
ASIDE = se3.exp([0.3, 0.1, 0.0, 0.0, 0.0, 0.1])
TURNED = se3.exp([0.0, 0.0, 0.0, 0.0, 0.1, 0.0])
# By no more than fixes err, and yet always the same way.
BIASED = [se3.exp([side, 0.0, 0.0, 0.0, 0.005, 0.0]) for side in (0.3, -0.3)]


def refused(drive: SimulatedDrive, n: int, offset: Mat4 | None) -> Fix:
    """A fix that says the camera is moved by `offset` and turned by it where it is."""
    fix = drive.fix(n)
    assert fix.T_map_cam is not None
    T = fix.T_map_cam.copy()
    if offset is not None:
        T[:3, :3] = offset[:3, :3] @ T[:3, :3]
        T[:3, 3] += offset[:3, 3]
    reason = "little of what should be seen is seen"
    return dataclasses.replace(fix, found=False, reason=reason, T_map_cam=T)


def silent_after(offsets: list[Mat4 | None]) -> tuple[list[bool], Registration, SimulatedDrive]:
    """Whether no pose is told after each refused fix of a drive that is well known before."""
    drive, registration = SimulatedDrive(90), Registration(CONFIG)
    play(drive, registration, range(40), fix_every=6)
    silent = []
    for n, offset in zip(range(40, 80, 3), offsets, strict=False):
        registration.step(drive.update(n))
        assert not registration.accept(refused(drive, n, offset)).accepted
        silent.append(registration.step(drive.update(n + 1)) is None)
    return silent, registration, drive


def test_the_same_other_place_told_three_times_silences_until_a_good_fix() -> None:
    silent, registration, drive = silent_after([ASIDE] * 4)
    assert silent == [False, False, True, True]

    assert registration.step(drive.update(51)) is None
    assert registration.accept(drive.fix(51)).accepted

    assert registration.step(drive.update(52)) is not None


@pytest.mark.parametrize(
    "offsets",
    [
        [None] * 6,
        [ASIDE, ASIDE, None, ASIDE, ASIDE, None],
        [ASIDE, se3.inverse(ASIDE)] * 3,  # chance finds, each another place
        [TURNED, se3.inverse(TURNED)] * 3,
        BIASED * 3,
    ],
    ids=["fitting", "one fits", "elsewhere each", "turned each", "biased"],
)
def test_refused_fixes_that_fit_or_tell_other_places_change_nothing(
    offsets: list[Mat4 | None],
) -> None:
    assert not any(silent_after(offsets)[0])


def test_the_same_other_direction_told_from_the_same_place_silences() -> None:
    assert silent_after([TURNED] * 4)[0] == [False, False, True, True]


def test_refused_fixes_do_not_free_what_they_silenced() -> None:
    silent, _, _ = silent_after([ASIDE] * 3 + [None] * 4 + [ASIDE, se3.inverse(ASIDE)] * 2)
    assert silent == [False, False, *[True] * 9]


def test_what_spoke_against_an_odometry_says_nothing_of_the_next_one() -> None:
    _, registration, old = silent_after([ASIDE] * 2)
    new = SimulatedDrive(90, odom_id=2, seed=1)
    for n in range(45, 57):  # it starts anew, and fixes come that are linked once it has
        waiting = OdometryUpdate(n, old.update(n).t_ns, OdometryState.INITIALISING, odom_id=1)
        registration.step(waiting)
        if n % 5 == 0:
            registration.accept(dataclasses.replace(old.fix(n), odom_id=None, log_scale=None))
    registration.step(new.update(57))
    assert registration.settled

    assert not registration.accept(refused(new, 57, ASIDE)).accepted

    assert registration.step(new.update(58)) is not None


def test_a_refused_fix_whose_covariance_overflows_says_nothing() -> None:
    drive, registration = SimulatedDrive(90), Registration(CONFIG)
    play(drive, registration, range(40), fix_every=6)
    for n in range(40, 49, 3):
        registration.step(drive.update(n))
        fix = refused(drive, n, ASIDE)
        assert fix.covariance is not None
        registration.accept(dataclasses.replace(fix, covariance=1e308 * np.eye(6)))

    assert registration.step(drive.update(49)) is not None
