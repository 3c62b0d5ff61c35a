# SPDX-License-Identifier: Apache-2.0
"""Which fixes are believed: enough of them, independent, that agree by the odometry."""

import msgspec
import numpy as np
import pytest

from edge.config.registration import RegistrationConfig
from edge.geometry import se3
from edge.registration.registration import Registration
from tests.edge.registration.simulated_drive import (
    ELSEWHERE,
    SimulatedDrive,
    error_m,
    play,
)

CONFIG = RegistrationConfig()


def test_first_pose_needs_two_agreeing_fixes_and_a_third_that_does_not_speak_against_them() -> None:
    drive, registration = SimulatedDrive(60), Registration(CONFIG)
    poses, verdicts = play(drive, registration, range(20), fix_every=8)
    assert [v.accepted for v in verdicts] == [False, True, True]
    assert all(p is None for p in poses[:17])
    assert poses[17] is not None
    assert error_m(drive, poses[17]) < 0.02


@pytest.mark.parametrize("with_scale", [False, True])
def test_two_fixes_that_are_wrong_alike_are_not_published(with_scale: bool) -> None:
    drive, registration = SimulatedDrive(120), Registration(CONFIG)
    poses = []
    for n in range(90):
        poses.append(registration.step(drive.update(n)))
        if n % 6 == 0:
            offset = ELSEWHERE if n in (0, 6) else None
            registration.accept(drive.fix(n, offset, with_scale=with_scale))
    told = [p for p in poses if p is not None]
    assert len(told) > 40
    assert max(error_m(drive, p) for p in told) < 0.02


def test_two_fixes_of_one_view_are_one_vote() -> None:
    far = msgspec.structs.replace(CONFIG, vote_baseline_depth_share=0.02)
    drive, registration = SimulatedDrive(60), Registration(far)
    for n in (0, 1, 2):
        registration.step(drive.update(n))
    # 2 cm of baseline at 2 m of depth is not enough, 4 cm would be; the map keyframes are the same.
    assert not registration.accept(drive.fix(0, support=(4, 5))).accepted
    assert not registration.accept(drive.fix(1, support=(4, 5))).accepted
    assert registration.accept(drive.fix(2, support=(8, 9))).accepted


def test_many_fixes_of_one_view_do_not_push_out_an_earlier_one() -> None:
    far = msgspec.structs.replace(CONFIG, vote_baseline_depth_share=0.05)
    drive, registration = SimulatedDrive(60), Registration(far)
    verdicts = []
    for n in range(8):
        # Two centimetres apart at 2 m of depth: no two of any three in a row are two votes.
        registration.step(drive.update(n))
        verdicts.append(registration.accept(drive.fix(n, support=(4, 5))).accepted)
    assert not any(verdicts[:4])
    assert any(verdicts)


def test_a_lone_wrong_fix_between_right_ones_is_not_published() -> None:
    drive, registration = SimulatedDrive(90), Registration(CONFIG)
    poses = []
    for n in range(60):
        poses.append(registration.step(drive.update(n)))
        if n % 8 == 0:
            registration.accept(drive.fix(n, ELSEWHERE if n == 8 else None))
    assert all(p is None for p in poses[:25])
    assert all(error_m(drive, p) < 0.02 for p in poses[25:])


def test_fixes_that_never_agree_by_the_odometry_speak_against_it() -> None:
    drive, registration, rng = SimulatedDrive(90), Registration(CONFIG), np.random.default_rng(0)
    for n in range(60):
        registration.step(drive.update(n))
        if n % 5 == 0:
            # By this odometry no two fixes are where the others have them.
            bent = np.eye(4)
            bent[:3, 3] = rng.uniform(-0.8, 0.8, 3)
            assert not registration.accept(drive.fix(n, bent, with_scale=False)).accepted
    assert registration.take_contradiction()
    assert not registration.take_contradiction()


@pytest.mark.parametrize(("wrong_every", "contradicted"), [(2, True), (5, False)])
def test_too_many_fixes_against_the_odometry_end_it_though_others_agree(
    wrong_every: int, contradicted: bool
) -> None:
    drive, registration, rng = SimulatedDrive(200), Registration(CONFIG), np.random.default_rng(0)
    play(drive, registration, range(50))
    told = []
    for n in range(50, 200):
        registration.step(drive.update(n))
        if n % 6 == 0:
            wrong = n // 6 % wrong_every == 0
            aside = se3.exp(np.append(rng.uniform(0.3, 0.8, 3), np.zeros(3))) if wrong else None
            assert registration.accept(drive.fix(n, aside)).accepted == (not wrong)
            told.append(registration.take_contradiction())
    assert any(told) == contradicted
    assert told[:6] == [False] * 6


def test_right_fixes_never_speak_against_the_odometry() -> None:
    drive, registration = SimulatedDrive(90, drift=0.02), Registration(CONFIG)
    for n in range(90):
        registration.step(drive.update(n))
        if n % 3 == 0:
            registration.accept(drive.fix(n))
        assert not registration.take_contradiction()


def test_consistent_rejected_fixes_overrule_the_anchor_and_count_a_reset() -> None:
    drive, registration = SimulatedDrive(200), Registration(CONFIG)
    poses, _ = play(drive, registration, range(50))
    resets = poses[-1].reset_counter
    verdicts = []
    for n in range(50, 110):
        poses.append(registration.step(drive.update(n)))
        if n % 6 == 0:
            verdicts.append(registration.accept(drive.fix(n, ELSEWHERE)))
    assert [v.accepted for v in verdicts[:4]] == [False, False, True, True]
    T_true = ELSEWHERE @ drive.T_map_cam[109]
    assert np.linalg.norm(poses[-1].T_map_cam[:3, 3] - T_true[:3, 3]) < 0.02
    assert poses[-1].reset_counter == resets + 1


def test_scattered_wrong_fixes_never_overrule() -> None:
    drive, registration = SimulatedDrive(200), Registration(CONFIG)
    play(drive, registration, range(50))
    rng = np.random.default_rng(3)
    for n in range(50, 110):
        pose = registration.step(drive.update(n))
        if n % 6 == 0:
            assert not registration.accept(drive.fix(n, se3.exp(0.3 * rng.normal(size=6)))).accepted
        assert pose is None or error_m(drive, pose) < 0.06


def test_after_long_silence_a_single_fix_is_not_enough() -> None:
    drive, registration = SimulatedDrive(1200), Registration(CONFIG)
    play(drive, registration, range(60))
    n = 60
    while registration.step(drive.update(n)) is not None or n < 1000:
        n += 1
    assert not registration.accept(drive.fix(n)).accepted
    for _ in range(10):
        n += 1
        assert registration.step(drive.update(n)) is None
    assert registration.accept(drive.fix(n)).accepted
    pose = registration.step(drive.update(n + 1))
    assert pose is not None
    assert error_m(drive, pose) < 0.02
