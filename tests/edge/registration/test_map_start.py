# SPDX-License-Identifier: Apache-2.0
"""An odometry that started from depths that the map told of a fix."""

import dataclasses

import msgspec
import numpy as np
import pytest

from edge.config.registration import RegistrationConfig
from edge.geometry import se3
from edge.registration.registration import Registration
from edge.types import (
    DepthSamples,
    Fix,
    Frame,
    KeyframePose,
    KeyframeResult,
    Mat4,
    OdometryState,
    OdometryUpdate,
)
from tests.edge.registration.simulated_drive import (
    ELSEWHERE,
    FRAME_NS,
    SimulatedDrive,
    error_m,
)

CONFIG = RegistrationConfig()
FAR = msgspec.structs.replace(CONFIG, vote_baseline_depth_share=0.02)  # two votes from 4 cm on


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


def test_fixes_need_no_scale_where_the_odometry_started_from_the_first() -> None:
    drive, registration = SimulatedDrive(60, scale=1.0), Registration(CONFIG)
    assert not registration.accept(unlinked(drive, 0)).accepted
    assert registration.step(start_from_map(drive, 0, 5)) is None
    # Of a frame before the start took effect, which it has followed.
    assert registration.accept(unlinked(drive, 4)).accepted
    assert registration.step(drive.update(6)) is None
    assert registration.accept(drive.fix(6, with_scale=False)).accepted
    pose = registration.step(drive.update(7))
    assert pose is not None
    assert error_m(drive, pose) < 0.02


@pytest.mark.parametrize("scale", [0.8, 1.25])
def test_a_start_of_a_wrong_scale_waits_for_a_third_fix_and_takes_its_scale_from_the_way(
    scale: float,
) -> None:
    drive, registration = SimulatedDrive(60, scale=scale), Registration(CONFIG)
    registration.accept(unlinked(drive, 0, noisy=False))
    poses = [registration.step(start_from_map(drive, 0, 5))]
    for n in range(6, 40):
        if n in (9, 20, 26):
            assert registration.accept(drive.fix(n - 1, noisy=False, with_scale=False)).accepted
        poses.append(registration.step(drive.update(n)))
    assert poses[:15] == [None] * 15
    told = [pose for pose in poses[15:] if pose is not None]
    assert len(told) == 20
    assert max(error_m(drive, pose) for pose in told) < 0.02


def test_the_two_fixes_of_a_start_are_not_yet_settled() -> None:
    drive, registration = SimulatedDrive(60, scale=1.0), Registration(CONFIG)
    registration.accept(unlinked(drive, 0, noisy=False))
    registration.step(start_from_map(drive, 0, 5))
    settled = []
    for n in (6, 7, 8):
        registration.step(drive.update(n))
        registration.accept(drive.fix(n, noisy=False))
        settled.append((registration.confirmed, registration.settled))
    assert settled == [(True, False), (True, True), (True, True)]


def test_the_final_trajectory_counts_fixes_of_frames_that_the_start_has_followed() -> None:
    drive, registration = SimulatedDrive(60, scale=1.0), Registration(CONFIG)
    # The first is of a frame before the start, so all that is known is of a followed one.
    registration.accept(unlinked(drive, 0, noisy=False))
    registration.step(start_from_map(drive, 0, 5))
    assert registration.accept(unlinked(drive, 4, noisy=False)).accepted
    registration.step(drive.update(6))
    final = registration.trajectory()
    assert [t_ns for t_ns, _ in final] == [5 * FRAME_NS, 6 * FRAME_NS]
    for (_, T), n in zip(final, (5, 6), strict=True):
        assert np.linalg.norm(T[:3, 3] - drive.T_map_cam[n][:3, 3]) < 1e-3


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


def refuted(drive: SimulatedDrive, registration: Registration) -> bool:
    """Start from the fix of frame 0, give right ones of 1 and 4; whether the start is refuted."""
    registration.step(start_from_map(drive, 0, 2))
    for n in (1, 4):
        for k in range(3, n + 1):
            assert registration.step(drive.update(k)) is None
        registration.accept(drive.fix(n, with_scale=False))
        if registration.take_contradiction():
            return True
    return False


def about_the_camera(T_map_cam: Mat4, angle: float) -> Mat4:
    """Offset that turns a camera on the spot."""
    return T_map_cam @ se3.exp([0.0, 0.0, 0.0, 0.0, angle, 0.0]) @ se3.inverse(T_map_cam)


@pytest.mark.parametrize("kind", ["right", "elsewhere", "turned"])
def test_a_start_from_a_wrong_fix_is_refuted_by_the_next_ones(kind: str) -> None:
    drive, registration = SimulatedDrive(60, scale=1.0), Registration(FAR)
    # The turned one is at the same place as the second: only the third is a vote of its own.
    turned = about_the_camera(drive.T_map_cam[0], 0.4)
    offset = {"right": None, "elsewhere": ELSEWHERE, "turned": turned}[kind]
    first = unlinked(drive, 0, offset=offset)
    start = registration.founding(with_depth(first))
    assert start is not None
    assert start.index == first.index
    registration.accept(first)
    assert refuted(drive, registration) == (kind != "right")
    registration.step(drive.update(5))
    assert registration.confirmed == (kind == "right")


@pytest.mark.parametrize("wrong", [False, True])
def test_fixes_of_a_camera_at_rest_judge_a_start_that_they_agree_without(wrong: bool) -> None:
    far = msgspec.structs.replace(CONFIG, vote_baseline_depth_share=0.5)
    drive, registration = SimulatedDrive(60, scale=1.0), Registration(far)
    turned = about_the_camera(drive.T_map_cam[0], 0.4)
    registration.accept(unlinked(drive, 0, offset=turned if wrong else None))
    registration.step(start_from_map(drive, 0, 3))
    refuted, sure = False, False
    for n in range(4, 28):
        sure = registration.step(drive.update(n)) is not None
        if n % 3 == 0:
            # Four of them span the time of a rest before the first one is among them.
            registration.accept(drive.fix(n, with_scale=False, sigmas=0.3))
            refuted = refuted or registration.take_contradiction()
        if refuted or sure:
            break
    assert (refuted, sure) == (wrong, not wrong)


def test_after_a_refuted_start_one_fix_is_not_enough_for_the_next() -> None:
    drive, registration = SimulatedDrive(60, scale=1.0), Registration(FAR)
    registration.accept(unlinked(drive, 0, offset=ELSEWHERE))
    assert refuted(drive, registration)
    told = [with_depth(unlinked(drive, n)) for n in (10, 11, 14)]
    founders = []
    for fix in told:
        registration.step(OdometryUpdate(fix.index, fix.t_ns, OdometryState.WAITING, 2))
        founders.append(registration.founding(fix))
        registration.accept(fix)
    # 2.5 cm of baseline are not two votes.
    assert founders[:2] == [None, None]
    assert founders[2] is not None
    assert founders[2].index == told[1].index
    assert founders[2].depth is told[1].depth
    # Nor is one that is there too soon.
    too_soon = with_depth(unlinked(drive, 16, offset=se3.exp([2.0, 0.0, 0.0, 0.0, 0.0, 0.0])))
    assert registration.founding(too_soon) is None


def test_after_a_refuted_start_fixes_of_a_camera_at_rest_are_enough() -> None:
    drive, registration = SimulatedDrive(60, scale=1.0), Registration(CONFIG)
    registration.accept(unlinked(drive, 0, offset=ELSEWHERE))
    assert refuted(drive, registration)
    founders = []
    for n in range(10, 30, 3):
        fix = with_depth(unlinked(drive, 10, sigmas=0.3))
        fix = dataclasses.replace(fix, index=n, t_ns=n * FRAME_NS)
        registration.step(OdometryUpdate(n, n * FRAME_NS, OdometryState.WAITING, 2))
        founders.append(registration.founding(fix))
        registration.accept(fix)
    # Four of them, 0.3 s apart, were known before the fifth; an odometry is to follow all four.
    assert founders[:4] == [None] * 4
    assert [fix.index for fix in founders[4:]] == [10, 13, 16]


def test_two_fixes_tell_how_the_camera_moves_unless_it_cannot_have_come_so_far() -> None:
    drive, registration = SimulatedDrive(60, scale=1.0), Registration(CONFIG)
    told = []
    beyond = se3.exp([50.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    for n, offset in ((0, None), (9, None), (12, beyond)):
        fix = with_depth(unlinked(drive, n, offset=offset, noisy=False))
        told.append(registration.founding(fix))
        registration.accept(fix)
    T_0_9 = se3.inverse(drive.T_map_cam[0]) @ drive.T_map_cam[9]
    true = se3.log(T_0_9) / (9 * FRAME_NS * 1e-9)
    for start, expected in zip(told, (np.zeros(6), true, np.zeros(6)), strict=True):
        assert start is not None
        assert start.velocity == pytest.approx(expected, abs=1e-9)


def with_depth(fix: Fix) -> Fix:
    some = np.ones(100, np.float32)
    return dataclasses.replace(fix, depth=DepthSamples(np.ones((100, 2), np.float32), some, some))
