# SPDX-License-Identifier: Apache-2.0
"""Fixes and odometry joined: what is taken in, when, and what comes of it."""

import dataclasses
import math

import numpy as np
import pytest

from edge.config.registration import RegistrationConfig
from edge.geometry import se3
from edge.registration.registration import Registration
from edge.registration.verdict import FixVerdict
from edge.types import DepthSamples, OdometryState, OdometryUpdate
from tests.edge.registration.simulated_drive import (
    ELSEWHERE,
    FRAME_NS,
    SimulatedDrive,
    error_m,
    play,
)

CONFIG = RegistrationConfig()


def test_wrong_fix_is_rejected_with_its_reason() -> None:
    drive, registration = SimulatedDrive(90), Registration(CONFIG)
    play(drive, registration, range(40))
    before = registration.step(drive.update(40))
    verdict = registration.accept(drive.fix(40, ELSEWHERE))
    assert not verdict.accepted
    assert verdict.reason.startswith("disagrees with the odometry, chi2")
    # Which of the two is wrong, only the next fix tells.
    assert registration.step(drive.update(41)) is None
    assert not registration.confirmed
    assert registration.accept(drive.fix(41)).accepted
    after = registration.step(drive.update(42))
    assert error_m(drive, after) < error_m(drive, before) + 1e-2


def test_not_found_and_foreign_fixes_are_rejected() -> None:
    drive, registration = SimulatedDrive(90), Registration(CONFIG)
    play(drive, registration, range(20))
    lost = dataclasses.replace(drive.fix(19), found=False, reason="few matches")
    assert registration.accept(lost) == FixVerdict(False, "few matches")
    other = dataclasses.replace(drive.fix(19), odom_id=7)
    assert registration.accept(other) == FixVerdict(False, "odometry restarted")
    assert registration.accept(drive.fix(80)) == FixVerdict(False, "frame unknown")
    assert registration.accept(drive.fix(3)) == FixVerdict(False, "older than the last")
    broken = dataclasses.replace(drive.fix(19), covariance=np.full((6, 6), np.nan))
    assert registration.accept(broken) == FixVerdict(False, "not a number")


@pytest.mark.parametrize("size", [0.0, 1e-300, 1e300, -1e-4])
def test_impossible_covariances_end_in_silence_and_right_fixes_end_that(size: float) -> None:
    drive, registration = SimulatedDrive(200), Registration(CONFIG)
    play(drive, registration, range(30))
    odd = size * np.eye(6)
    for n in range(30, 60):
        pose = registration.step(drive.update(n))
        if n % 3 == 0:
            registration.accept(dataclasses.replace(drive.fix(n), covariance=odd))
        assert pose is None or error_m(drive, pose) < 0.05
    poses, _ = play(drive, registration, range(60, 200))
    assert poses[-1] is not None
    assert error_m(drive, poses[-1]) < 0.03


def test_late_fix_is_applied_at_its_own_frame() -> None:
    errors = {}
    for delay in (0, 9):
        drive, registration = SimulatedDrive(120), Registration(CONFIG)
        poses, _ = play(drive, registration, range(100), delay=delay, noisy=False)
        errors[delay] = max(error_m(drive, p) for p in poses[40:])
    assert errors[0] < 1e-6
    assert errors[9] < 1e-6


@pytest.mark.parametrize("with_scale", [True, False], ids=["depths", "baselines"])
def test_scale_converges_to_truth(with_scale: bool) -> None:
    errors = []
    for seed in range(5):
        drive, registration = SimulatedDrive(150, scale=2.6, seed=seed), Registration(CONFIG)
        poses, _ = play(drive, registration, range(140), with_scale=with_scale)
        errors.append(math.log(poses[-1].scale / 2.6))
    assert np.std(errors) < 0.01


def test_depths_of_a_fix_are_told_in_the_units_of_the_odometry() -> None:
    drive, registration = SimulatedDrive(150, scale=2.6), Registration(CONFIG)
    told = DepthSamples(*(np.ones(s, np.float32) for s in ((1, 2), 1, 1)))
    fix = dataclasses.replace(drive.fix(100), depth=told)
    assert registration.depth_in_odometry(fix) is None
    play(drive, registration, range(140), with_scale=True)
    depth = registration.depth_in_odometry(fix)
    assert depth is not None
    # map metres are 2.6 of its units: what is 1 m away there is 1 / 2.6 units away
    assert depth.inverse_depth[0] == pytest.approx(2.6, rel=0.05)
    assert depth.sigma[0] == pytest.approx(2.6, rel=0.05)
    assert registration.depth_in_odometry(drive.fix(100)) is None


def test_scale_drift_is_followed() -> None:
    drive, registration = SimulatedDrive(300), Registration(CONFIG)
    for n in range(1, 300):  # the odometry's unit grows by 8 % over the drive
        step = se3.inverse(drive.T_map_cam[n - 1]) @ drive.T_map_cam[n]
        step[:3, 3] /= drive.scale * math.exp(0.08 * n / 300)
        drive.T_odom_cam[n] = drive.T_odom_cam[n - 1] @ step
    poses, verdicts = play(drive, registration, range(300), with_scale=False)
    assert sum(not v.accepted for v in verdicts) <= 2
    assert poses[-1].scale == pytest.approx(drive.scale * math.exp(0.08), rel=0.03)
    assert max(error_m(drive, p) for p in poses[60:]) < 0.03


def test_nothing_is_published_after_a_loss_until_fixes_agree_again() -> None:
    drive, registration = SimulatedDrive(120), Registration(CONFIG)
    poses, _ = play(drive, registration, range(50))
    lost = OdometryUpdate(50, 50 * FRAME_NS, OdometryState.LOST, 1)
    assert registration.step(lost) is None
    prior = registration.prior(lost)
    assert prior is not None
    assert np.linalg.norm(prior[0][:3, 3] - drive.T_map_cam[50][:3, 3]) < 0.05

    again = SimulatedDrive(120, scale=1.9, odom_id=2)
    after, verdicts = play(again, registration, range(51, 90), fix_every=10)
    first = next(i for i, p in enumerate(after) if p is not None)
    assert [v.accepted for v in verdicts[:3]] == [False, True, True]
    assert after[first].index == 81
    assert after[first].scale == pytest.approx(1.9, rel=0.03)
    assert after[first].reset_counter == poses[-1].reset_counter + 1


def test_a_lens_found_to_be_wrong_takes_back_the_fixes_so_far() -> None:
    drive, registration = SimulatedDrive(120), Registration(CONFIG)
    poses, _ = play(drive, registration, range(50))
    assert poses[-1] is not None
    wrong = dataclasses.replace(drive.fix(49), found=False, reason="its lens", lens_wrong=True)
    assert registration.accept(wrong).reason == "its lens"
    assert registration.step(drive.update(50)) is None
    again, _ = play(drive, registration, range(51, 100))
    assert again[-1] is not None


def test_prior_is_that_of_the_keyframe() -> None:
    drive, registration = SimulatedDrive(60), Registration(CONFIG)
    play(drive, registration, range(47), noisy=False)
    update = drive.update(47)
    registration.step(update)
    assert update.keyframe is not None
    T, covariance = registration.prior(update)
    assert np.linalg.norm(T[:3, 3] - drive.T_map_cam[45][:3, 3]) < 1e-6
    assert np.all(np.linalg.eigvalsh(covariance) > 0.0)


def test_fixes_from_before_the_start_of_the_odometry_count_if_it_began_with_their_frames() -> None:
    drive, registration = SimulatedDrive(60), Registration(CONFIG)
    for n in range(12):
        registration.step(OdometryUpdate(n, n * FRAME_NS, OdometryState.INITIALISING, 1))
        if n in (0, 3, 5, 10):  # 3 is no keyframe of the window that follows
            fix = dataclasses.replace(drive.fix(n, with_scale=False), odom_id=None, T_odom_cam=None)
            assert not registration.accept(fix).accepted
    pose = registration.step(drive.update(12))  # carries the window of frames 0, 5 and 10
    assert pose is not None
    assert error_m(drive, pose) < 0.02
    assert pose.scale == pytest.approx(drive.scale, rel=0.1)


def test_runs_are_identical() -> None:
    runs = []
    for _ in range(2):
        drive, registration = SimulatedDrive(80, drift=0.01), Registration(CONFIG)
        poses, _ = play(drive, registration, range(80))
        runs.append((poses, registration.trajectory()))
    for a, b in zip(runs[0][0], runs[1][0], strict=True):
        assert (a is None) == (b is None)
        assert a is None or np.array_equal(a.T_map_cam_smooth, b.T_map_cam_smooth)
    assert all(np.array_equal(a, b) for (_, a), (_, b) in zip(runs[0][1], runs[1][1], strict=True))
