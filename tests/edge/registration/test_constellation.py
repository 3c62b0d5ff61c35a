# SPDX-License-Identifier: Apache-2.0
import dataclasses
import itertools
import math

import msgspec
import numpy as np
import pytest

from edge.config.registration import RegistrationConfig
from edge.geometry import se3, so3
from edge.registration.constellation import Constellation, Estimate
from edge.registration.motion import OdometryTrack
from edge.registration.noise import pose_difference
from tests.edge.registration.simulated_drive import DEPTH_M, SimulatedDrive

CONFIG = RegistrationConfig()


def held(
    drive: SimulatedDrive, indices: range, config: RegistrationConfig = CONFIG, **options: bool
) -> tuple[Constellation, OdometryTrack]:
    """Constellation of the fixes of frames `indices`, and the track of the whole drive."""
    track = OdometryTrack(1, 1000)
    for n in range(len(drive.T_odom_cam)):
        track.add(drive.update(n))
    first, *others = (drive.fix(n, **options) for n in indices)
    anchors = Constellation(track, math.log(drive.scale) + 0.02, config, [first])
    for fix in others:
        anchors.add(fix)
    return anchors, track


def off(drive: SimulatedDrive, n: int, estimate: Estimate) -> np.ndarray:
    return pose_difference(estimate.T_map_cam, drive.T_map_cam[n])


@pytest.mark.parametrize("with_scale", [True, False], ids=["depths", "baselines"])
def test_exact_fixes_give_exact_poses_and_scale(with_scale: bool) -> None:
    drive = SimulatedDrive(120)
    anchors, track = held(drive, range(0, 100, 10), noisy=False, with_scale=with_scale)
    anchors.add(drive.fix(100, noisy=False, with_scale=with_scale))  # linearises nearer by
    for n in (3, 55, 119):
        estimate = anchors.locate(track.frame(n))
        np.testing.assert_allclose(off(drive, n, estimate), 0.0, atol=2e-4)
        assert estimate.scale == pytest.approx(drive.scale, rel=1e-3)


def test_frames_until_the_next_news_are_as_if_each_was_solved_for() -> None:
    drive = SimulatedDrive(90, drift=0.02)
    anchors, track = held(drive, range(0, 60, 6))
    solved = {}
    for n in (60, 62):
        track.revision += 1
        solved[n] = anchors.locate(track.frame(n))
    track.revision += 1
    anchors.locate(track.frame(60))
    carried = anchors.locate(track.frame(62))
    sigma = np.sqrt(np.diag(solved[62].covariance))
    difference = pose_difference(carried.T_map_cam, solved[62].T_map_cam)
    assert np.all(np.abs(difference) < 0.3 * sigma)
    assert np.all(np.diag(carried.covariance) >= 0.95 * np.diag(solved[62].covariance))


def test_many_fixes_from_one_place_never_look_better_than_their_common_error() -> None:
    drive = SimulatedDrive(40)
    drive.T_map_cam = [drive.T_map_cam[0]] * 40
    drive.T_odom_cam = [drive.T_odom_cam[0]] * 40
    one, track = held(drive, range(1))
    many, _ = held(drive, range(40))
    alone = one.locate(track.frame(39)).covariance[0, 0]
    together = many.locate(track.frame(39)).covariance[0, 0]
    assert CONFIG.common_share * alone * 0.95 < together < 0.7 * alone


def test_a_keyframe_of_long_ago_that_the_window_still_holds_counts_as_near() -> None:
    """Gone round and back to where the good fixes were: there they count again."""
    drive = SimulatedDrive(241)
    half = drive.T_map_cam[:121]
    drive.T_map_cam = [*half, *half[-2::-1]]
    there = drive.T_odom_cam[:121]
    drive.T_odom_cam = [*there, *there[-2::-1]]
    good = [drive.fix(n) for n in (0, 4, 8)]
    poor = [drive.fix(n, sigmas=20.0, with_scale=False) for n in (100, 160, 230)]
    sigma = {}
    for share in (0.0, 1.0):
        config = msgspec.structs.replace(CONFIG, drift_path_share=share)
        anchors, track = held(drive, range(1), config)
        anchors = Constellation(track, math.log(drive.scale), config, [*good, *poor])
        estimate = anchors.locate(track.frame(238))
        sigma[share] = math.sqrt(np.trace(estimate.covariance[:3, :3]))
    assert sigma[0.0] < 0.5 * sigma[1.0]


@pytest.mark.parametrize(("drift", "low", "high"), [(0.0, 0.0, 0.35), (0.15, 0.55, 1.7)])
def test_drift_is_learnt_from_the_fixes(drift: float, low: float, high: float) -> None:
    factors = []
    for seed in range(5):
        drive = SimulatedDrive(300, drift=drift, seed=seed)
        anchors, track = held(drive, range(0, 300, 20), with_scale=False)
        factors.append(anchors.locate(track.frame(299)).drift.shift)
    assert low < np.median(factors) < high


def wandering(shift: float, bend: float, seed: int) -> SimulatedDrive:
    """A drive whose odometry drifts by so many times the configuration's shift and bend."""
    drive = SimulatedDrive(300, seed=seed)
    for n, (a, b) in enumerate(itertools.pairwise(drive.T_map_cam)):
        step = se3.inverse(a) @ b
        share, turn = np.linalg.norm(step[:3, 3]) / DEPTH_M, so3.angle(step[:3, :3])
        sigma_m = shift * CONFIG.drift_position_depth_share * DEPTH_M * math.sqrt(share)
        sigma_rad = bend * CONFIG.drift_rotation_rad * math.sqrt(share + turn)
        step = se3.exp(drive.rng.normal(size=6) * np.repeat((sigma_m, sigma_rad), 3)) @ step
        step[:3, 3] /= drive.scale
        drive.T_odom_cam[n + 1] = drive.T_odom_cam[n] @ step
    return drive


def test_an_odometry_that_bends_is_told_from_one_that_shifts() -> None:
    ratio = {}
    for truth in ((1.6, 0.05), (0.05, 1.6)):
        learnt = []
        for seed in range(5):
            anchors, _ = held(wandering(*truth, seed), range(0, 300, 20), with_scale=False)
            learnt.append(anchors.drift.shift / anchors.drift.bend)
        ratio[truth] = np.median(learnt)
    assert ratio[1.6, 0.05] > 2.0
    assert ratio[0.05, 1.6] < 0.5


def test_a_fix_that_differs_is_told_by_how_much() -> None:
    drive = SimulatedDrive(90)
    anchors, _ = held(drive, range(0, 60, 6))
    right = [anchors.compare(drive.fix(n)).chi2_pose for n in range(61, 90)]
    assert np.mean(right) < 9.0
    for wrong in ([0.2, 0, 0, 0, 0, 0], [0, 0, 0, 0, 0, 0.3], [0, 0, 0, 0, math.pi, 0]):
        shifted = drive.fix(66)
        assert shifted.T_map_cam is not None
        T = se3.exp(np.r_[wrong[:3], 0, 0, 0]) @ shifted.T_map_cam
        T[:3, :3] = se3.exp(np.r_[0, 0, 0, wrong[3:]])[:3, :3] @ T[:3, :3]
        assert anchors.compare(dataclasses.replace(shifted, T_map_cam=T)).chi2_pose > 100.0


def test_joined_leaves_the_first_as_they_were() -> None:
    drive = SimulatedDrive(90)
    anchors, track = held(drive, range(0, 60, 6))
    before = anchors.locate(track.frame(80)).T_map_cam
    joined = anchors.joined([drive.fix(70), drive.fix(76)])
    assert joined is not None
    assert not np.array_equal(joined.locate(track.frame(80)).T_map_cam, before)
    np.testing.assert_array_equal(anchors.locate(track.frame(80)).T_map_cam, before)
    assert anchors.joined([drive.fix(70, se3.exp([0.3, 0, 0, 0, 0, 0]))]) is None


def test_the_oldest_outside_the_window_leaves_first() -> None:
    drive = SimulatedDrive(90)
    config = msgspec.structs.replace(CONFIG, held_fixes=4)
    anchors, track = held(drive, range(0, 90, 15), config)
    assert track.in_window(75)
    assert not track.in_window(15)
    assert anchors.is_late(75)
    assert not anchors.is_late(76)
    known = [math.sqrt(anchors.locate(track.frame(n)).covariance[0, 0]) for n in (0, 60)]
    assert known[0] > known[1]
