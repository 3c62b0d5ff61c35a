# SPDX-License-Identifier: Apache-2.0
import dataclasses
import itertools
import math
from collections.abc import Callable

import msgspec
import numpy as np
import pytest

from edge.config.registration import RegistrationConfig
from edge.geometry import se3
from edge.registration.registration import FixVerdict, Registration
from edge.types import (
    DepthSamples,
    Fix,
    Frame,
    KeyframePose,
    KeyframeResult,
    MapPose,
    OdometryState,
    OdometryUpdate,
)
from tests.edge.registration.simulated_drive import FRAME_NS, SimulatedDrive

CONFIG = RegistrationConfig()
ELSEWHERE = se3.exp([0.4, -0.2, 0.1, 0.1, 0.2, 0.0])


def play(
    drive: SimulatedDrive,
    registration: Registration,
    frames: range,
    fix_every: int = 6,
    delay: int = 0,
    **fix_options: object,
) -> tuple[list[MapPose | None], list[FixVerdict]]:
    poses, verdicts = [], []
    for n in frames:
        poses.append(registration.step(drive.update(n)))
        if (n - delay) % fix_every == 0 and n - delay >= frames.start:
            verdicts.append(registration.accept(drive.fix(n - delay, **fix_options)))
    return poses, verdicts


def error_m(drive: SimulatedDrive, pose: MapPose) -> float:
    return float(np.linalg.norm(pose.T_map_cam[:3, 3] - drive.T_map_cam[pose.index][:3, 3]))


def test_first_pose_needs_two_agreeing_fixes() -> None:
    drive, registration = SimulatedDrive(60), Registration(CONFIG)
    poses, verdicts = play(drive, registration, range(20), fix_every=8)
    assert [v.accepted for v in verdicts] == [False, True, True]
    assert all(p is None for p in poses[:9])
    assert poses[9] is not None
    assert error_m(drive, poses[9]) < 0.02


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
    assert all(p is None for p in poses[:17])
    assert all(error_m(drive, p) < 0.02 for p in poses[17:])


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


def test_right_fixes_never_speak_against_the_odometry() -> None:
    drive, registration = SimulatedDrive(90, drift=0.02), Registration(CONFIG)
    for n in range(90):
        registration.step(drive.update(n))
        if n % 3 == 0:
            registration.accept(drive.fix(n))
        assert not registration.take_contradiction()


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


def test_covariance_grows_between_fixes_until_silence() -> None:
    drive, registration = SimulatedDrive(900), Registration(CONFIG)
    poses, _ = play(drive, registration, range(60))
    for n in range(60, 900):
        poses.append(registration.step(drive.update(n)))
    sigmas = [math.sqrt(np.trace(p.covariance[:3, :3])) for p in poses[60:] if p is not None]
    assert all(b > a for a, b in zip(sigmas, sigmas[20:], strict=False))
    assert poses[-1] is None


def test_published_covariance_is_honest() -> None:
    nees = []
    for seed in range(12):
        drive, registration = SimulatedDrive(150, drift=0.02, seed=seed), Registration(CONFIG)
        poses, _ = play(drive, registration, range(140))
        for p in poses[60::20]:
            e = p.T_map_cam[:3, 3] - drive.T_map_cam[p.index][:3, 3]
            nees.append(e @ np.linalg.solve(p.covariance[:3, :3], e))
    # The fixes' noise is white here, the filter believes 60 % of it common: a little modest.
    assert 0.2 < np.mean(nees) / 3.0 < 1.5


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


def test_nothing_is_published_after_a_loss_until_fixes_agree_again() -> None:
    drive, registration = SimulatedDrive(120), Registration(CONFIG)
    poses, _ = play(drive, registration, range(50))
    lost = OdometryUpdate(50, 50 * FRAME_NS, OdometryState.LOST, 1)
    assert registration.step(lost) is None
    prior = registration.prior(lost)
    assert prior is not None
    assert np.linalg.norm(prior[0][:3, 3] - drive.T_map_cam[50][:3, 3]) < 0.05

    again = SimulatedDrive(120, scale=1.9, odom_id=2)
    after, verdicts = play(again, registration, range(51, 80), fix_every=10)
    first = next(i for i, p in enumerate(after) if p is not None)
    assert [v.accepted for v in verdicts[:2]] == [False, True]
    assert after[first].index == 71
    assert after[first].scale == pytest.approx(1.9, rel=0.03)
    assert after[first].reset_counter == poses[-1].reset_counter + 1


def test_prior_is_that_of_the_keyframe() -> None:
    drive, registration = SimulatedDrive(60), Registration(CONFIG)
    play(drive, registration, range(47), noisy=False)
    update = drive.update(47)
    registration.step(update)
    assert update.keyframe is not None
    T, covariance = registration.prior(update)
    assert np.linalg.norm(T[:3, 3] - drive.T_map_cam[45][:3, 3]) < 1e-6
    assert np.all(np.linalg.eigvalsh(covariance) > 0.0)


def test_smooth_stream_moves_by_small_corrections_only() -> None:
    drive, registration = SimulatedDrive(200, drift=0.02), Registration(CONFIG)
    poses, _ = play(drive, registration, range(190), fix_every=12)
    poses = [p for p in poses if p is not None]
    for a, b in itertools.pairwise(poses):
        step = se3.inverse(drive.T_odom_cam[a.index]) @ drive.T_odom_cam[b.index]
        step[:3, 3] *= b.scale
        moved = a.T_map_cam_smooth @ step
        assert np.linalg.norm(b.T_map_cam_smooth[:3, 3] - moved[:3, 3]) < 0.0081
    off = [np.linalg.norm(p.T_map_cam_smooth[:3, 3] - p.T_map_cam[:3, 3]) for p in poses]
    assert max(off) < 0.03


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


# --- an odometry that started from the map ---


def start_from_map(drive: SimulatedDrive, began: int, now: int) -> OdometryUpdate:
    """The update with which a start from the map takes effect."""
    update = drive.update(now)
    image = np.zeros((2, 2), np.uint8)
    none = np.zeros(0, np.float32)
    keyframe = KeyframeResult(
        Frame(began, began * FRAME_NS, image),
        drive.T_odom_cam[began],
        DepthSamples(none.reshape(0, 2), none, none),
        (KeyframePose(began, drive.T_odom_cam[began]),),
        in_map_units=True,
        followed=tuple(KeyframePose(n, drive.T_odom_cam[n]) for n in range(began + 1, now)),
    )
    return dataclasses.replace(
        update,
        keyframe=keyframe,
        reference_index=began,
        T_reference_cam=se3.inverse(drive.T_odom_cam[began]) @ drive.T_odom_cam[now],
    )


def unlinked(drive: SimulatedDrive, n: int, **options: object) -> Fix:
    fix = drive.fix(n, with_scale=False, **options)
    return dataclasses.replace(fix, odom_id=None, T_odom_cam=None)


def test_two_fixes_are_enough_where_the_odometry_started_from_the_first() -> None:
    drive, registration = SimulatedDrive(60, scale=1.0), Registration(CONFIG)
    assert not registration.accept(unlinked(drive, 0)).accepted
    assert registration.step(start_from_map(drive, 0, 5)) is None
    # Of a frame before the start took effect, which it has followed.
    assert registration.accept(unlinked(drive, 4)).accepted
    pose = registration.step(drive.update(6))
    assert pose is not None
    assert error_m(drive, pose) < 0.02


def test_a_camera_that_hardly_moves_is_believed_after_a_while() -> None:
    far = msgspec.structs.replace(CONFIG, vote_baseline_depth_share=0.5)
    drive, registration = SimulatedDrive(60, scale=1.0), Registration(far)
    verdicts = [registration.accept(unlinked(drive, 0, sigmas=0.3)).accepted]
    registration.step(start_from_map(drive, 0, 3))
    for n in range(4, 16):
        registration.step(drive.update(n))
        if n % 3 == 0:
            verdicts.append(
                registration.accept(drive.fix(n, with_scale=False, sigmas=0.3)).accepted
            )
    assert verdicts == [False, False, False, True, True]


def test_fixes_that_scatter_are_not_those_of_a_camera_at_rest() -> None:
    far = msgspec.structs.replace(CONFIG, vote_baseline_depth_share=0.5)
    drive, registration = SimulatedDrive(60, scale=1.0), Registration(far)
    registration.step(start_from_map(drive, 0, 3))
    for n in range(4, 28):
        registration.step(drive.update(n))
        if n % 3 == 0:
            aside = np.eye(4)
            aside[0, 3] = 0.03 * (-1) ** n
            fix = drive.fix(n, aside, noisy=False, with_scale=False, sigmas=4.0)
            assert not registration.accept(fix).accepted
