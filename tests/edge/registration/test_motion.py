# SPDX-License-Identifier: Apache-2.0
import dataclasses

import numpy as np
import pytest

from edge.geometry import se3
from edge.registration.motion import OdometryTrack
from edge.types import KeyframePose
from tests.edge.registration.simulated_drive import SimulatedDrive


def tracked(n: int, capacity: int = 100) -> tuple[OdometryTrack, SimulatedDrive]:
    drive, track = SimulatedDrive(n), OdometryTrack(1, capacity)
    for k in range(n):
        track.add(drive.update(k))
    return track, drive


def test_between_is_the_odometrys_motion() -> None:
    track, drive = tracked(30)
    motion = track.between(4, 21)
    expected = se3.inverse(drive.T_odom_cam[4]) @ drive.T_odom_cam[21]
    np.testing.assert_allclose(motion.T_from_to, expected, atol=1e-12)
    steps = np.diff([T[:3, 3] for T in drive.T_odom_cam[4:22]], axis=0)
    assert motion.path == pytest.approx(np.linalg.norm(steps, axis=1).sum())
    assert track.between(21, 4).path == pytest.approx(motion.path)


def test_a_frame_moves_with_the_refinement_of_its_keyframe() -> None:
    track, drive = tracked(24)
    update = drive.update(22)
    bend = se3.exp([0.05, 0.0, 0.0, 0.0, 0.02, 0.0])
    assert update.keyframe is not None
    window = tuple(
        KeyframePose(k.index, bend @ k.T_odom_cam if k.index == 10 else k.T_odom_cam)
        for k in update.keyframe.window
    )
    track.add(
        dataclasses.replace(update, keyframe=dataclasses.replace(update.keyframe, window=window))
    )
    np.testing.assert_allclose(track.pose(13), bend @ drive.T_odom_cam[13], atol=1e-12)
    np.testing.assert_allclose(track.pose(17), drive.T_odom_cam[17], atol=1e-12)


def test_old_frames_are_forgotten() -> None:
    track, _ = tracked(50, capacity=20)
    assert not track.holds(29)
    assert track.holds(30)


def test_order_is_that_of_play_also_in_reverse() -> None:
    drive, track = SimulatedDrive(20), OdometryTrack(1, 100)
    for k in reversed(range(20)):
        track.add(dataclasses.replace(drive.update(k), keyframe=None))
    assert track.is_later(3, 12)


def test_a_keyframe_is_where_its_own_refinement_puts_it() -> None:
    track, drive = tracked(24)
    update = drive.update(22)
    bend = se3.exp([0.05, 0.0, 0.0, 0.0, 0.02, 0.0])
    assert update.keyframe is not None
    window = tuple(
        KeyframePose(k.index, bend @ k.T_odom_cam if k.index == 15 else k.T_odom_cam)
        for k in update.keyframe.window
    )
    before = track.revision
    track.add(
        dataclasses.replace(update, keyframe=dataclasses.replace(update.keyframe, window=window))
    )
    np.testing.assert_allclose(track.pose(15), bend @ drive.T_odom_cam[15], atol=1e-12)
    assert track.revision == before + 1
    assert track.in_window(15)
    assert not track.in_window(16)
