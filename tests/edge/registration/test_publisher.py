# SPDX-License-Identifier: Apache-2.0
"""What is told: covariances that are true, a stream that does not jump."""

import dataclasses
import itertools
import math

import numpy as np
import pytest

from edge.config.registration import RegistrationConfig
from edge.geometry import se3, so3
from edge.registration.registration import Registration
from tests.edge.registration.simulated_drive import (
    DEPTH_M,
    FRAME_NS,
    SimulatedDrive,
    play,
)

CONFIG = RegistrationConfig()


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


def test_a_turn_makes_poses_of_a_rolling_shutter_uncertain() -> None:
    sigmas = {}
    for readout_s in (0.0, 0.03):
        drive, registration = SimulatedDrive(60), Registration(CONFIG)
        for n in range(60):
            update = drive.update(n)
            if update.keyframe is not None:
                keyframe = dataclasses.replace(update.keyframe, readout_s=-readout_s)
                update = dataclasses.replace(update, keyframe=keyframe)
            pose = registration.step(update)
            if n % 8 == 0:
                registration.accept(drive.fix(n, noisy=False))
        assert pose is not None
        sigmas[readout_s] = math.sqrt(np.trace(pose.covariance[:3, :3]) / 3.0)
    turned = so3.angle(drive.T_map_cam[58][:3, :3].T @ drive.T_map_cam[59][:3, :3])
    rows = CONFIG.tracking_rows_share * turned * 0.03 / (FRAME_NS * 1e-9)
    assert rows * DEPTH_M > 0.001
    added = math.sqrt(sigmas[0.03] ** 2 - sigmas[0.0] ** 2)
    assert added == pytest.approx(rows * DEPTH_M, rel=0.05)


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
