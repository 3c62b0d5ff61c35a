# SPDX-License-Identifier: Apache-2.0
import dataclasses
import math
from collections.abc import Sequence

import numpy as np
import pytest

from edge.config.registration import RegistrationConfig
from edge.geometry import se3
from edge.registration.registration import Registration
from edge.registration.turning import TurnLoss, covariance
from edge.types import DepthSamples, MapPose, Mat4, OdometryState
from tests.edge.registration.simulated_drive import DEPTH_M, FRAME_NS, SimulatedDrive

TURN = range(60, 120)
FRAMES = 180
RESCALED = TURN.stop - 10


def scene(depth: float) -> DepthSamples:
    inverse = np.full(20, 1.0 / depth, np.float32)
    return DepthSamples(np.zeros((20, 2), np.float32), inverse, 0.01 * inverse)


def turning(step_m: float, step_rad: float, n: int) -> list[Mat4]:
    return [se3.exp([step_m * k, 0, 0, 0, step_rad * k, 0]) for k in range(n)]


def lost(poses: list[Mat4], depth: float = 3.0) -> float:
    turns = TurnLoss()
    turns.look(scene(depth))
    for n, T in enumerate(poses):
        turns.add(n, T)
    return sum(loss.variance for loss in turns.between(0, len(poses)))


def test_a_turn_on_the_spot_costs_the_scale_and_others_do_not() -> None:
    spot = lost(turning(0.0, 0.04, 60))
    assert spot > 1.0
    assert lost(turning(0.05, 0.04, 60)) < 0.01 * spot
    assert lost(turning(0.02, 0.0, 60)) == 0.0
    assert lost(turning(0.0, 1e-4, 60)) < 0.01 * spot


def test_a_turn_costs_nothing_while_half_of_the_view_stays() -> None:
    """A car in a bend: each view is left by moving on, and none is ever lost."""
    assert lost(turning(0.0, 0.04, 7)) == 0.0
    assert lost(turning(0.1, 0.04, 60)) == 0.0


def test_what_counts_is_the_way_in_depths_of_the_scene() -> None:
    poses = turning(0.003, 0.04, 60)
    assert lost(poses, depth=3.0) > 10.0 * lost(poses, depth=0.3)


def test_trembling_costs_nothing_however_long() -> None:
    rng = np.random.default_rng(0)
    assert lost([se3.exp(0.002 * rng.normal(size=6)) for _ in range(400)]) < 0.01


def test_beyond_a_loss_places_are_as_uncertain_as_they_are_far_from_it() -> None:
    turns = TurnLoss()
    turns.look(scene(3.0))
    for n, T in enumerate(turning(0.0, 0.04, 60)):
        turns.add(n, T)
    losses = turns.between(0, 60)
    total = sum(loss.variance for loss in losses)
    offsets = np.zeros((2, len(losses), 3))
    offsets[0, :, 0] = 0.5
    C = covariance(losses, np.array([0, 70]), 65, offsets)
    assert C[0, 0] == pytest.approx(0.25 * total)
    assert C[6, 6] == pytest.approx(total)
    np.testing.assert_array_equal(C[7:], 0.0)  # on this side of the turn


class RobotTurn(SimulatedDrive):
    """Walks, turns on the spot, and walks on; the odometry's unit is another after the turn."""

    def __init__(self, rescaled: float) -> None:
        super().__init__(FRAMES)
        self.rescaled = rescaled
        T, odom = np.eye(4), np.eye(4)
        self.T_map_cam, self.T_odom_cam = [], []
        for n in range(FRAMES):
            turned = 0.05 if n in TURN else 0.0
            moved = 0.0 if n in TURN else 0.02
            T = T @ se3.exp([0, 0, moved, 0, turned, 0])
            unit = self.scale * (rescaled if n > RESCALED else 1.0)
            odom = odom @ se3.exp([0, 0, moved / unit, 0, turned, 0])
            self.T_map_cam.append(T)
            self.T_odom_cam.append(odom)

    def play(self, fixes: Sequence[int]) -> tuple[Registration, dict[int, MapPose]]:
        registration, poses = Registration(RegistrationConfig()), {}
        for n in range(FRAMES):
            update = self.update(n)
            if update.keyframe is not None:
                depth = scene(DEPTH_M / self.scale)
                keyframe = dataclasses.replace(update.keyframe, depth=depth)
                update = dataclasses.replace(update, keyframe=keyframe)
            pose = registration.step(update)
            if pose is not None:
                poses[n] = pose
            if n in fixes:
                fix = self.fix(n, noisy=False)
                if n > RESCALED:
                    assert fix.log_scale is not None
                    told = fix.log_scale + math.log(self.rescaled)
                    fix = dataclasses.replace(fix, log_scale=told)
                registration.accept(fix)
        return registration, poses

    def off_m(self, n: int, T: Mat4) -> float:
        return float(np.linalg.norm(T[:3, 3] - self.T_map_cam[n][:3, 3]))


def test_no_pose_is_told_far_from_a_turn_that_cost_the_scale() -> None:
    drive = RobotTurn(rescaled=0.25)
    registration, poses = drive.play(fixes=range(0, 60, 8))
    assert set(range(20, TURN.stop)) <= set(poses)  # while it turns, its place is known
    for n, pose in poses.items():
        sigma_m = math.sqrt(np.linalg.eigvalsh(pose.covariance[:3, :3])[-1])
        assert drive.off_m(n, pose.T_map_cam) < max(0.01, 3.5 * sigma_m)
    assert max(poses) < TURN.stop + 15
    # Every tracked frame has its place in the end, the certain ones a right one.
    final = {t_ns // FRAME_NS: T for t_ns, T in registration.trajectory()}
    assert set(final) == set(range(FRAMES))
    assert max(drive.off_m(n, final[n]) for n in range(TURN.stop)) < 0.02


def test_fixes_after_the_turn_tell_the_new_scale() -> None:
    drive = RobotTurn(rescaled=0.25)
    _, poses = drive.play(fixes=[*range(0, 60, 8), *range(130, FRAMES, 8)])
    assert max(poses) == FRAMES - 1
    assert poses[FRAMES - 1].scale == pytest.approx(0.25 * drive.scale, rel=0.01)
    assert drive.off_m(FRAMES - 1, poses[FRAMES - 1].T_map_cam) < 0.01


def test_an_odometry_that_slips_while_it_is_lost_bends_nothing_before_or_after() -> None:
    drive, registration = SimulatedDrive(120), Registration(RegistrationConfig())
    away = se3.exp([0.3, 0.0, 0.0, 0.0, 0.1, 0.0])
    drive.T_odom_cam[71:] = [away @ T for T in drive.T_odom_cam[71:]]
    for n in range(120):
        update = drive.update(n)
        if n == 70:
            update = dataclasses.replace(update, state=OdometryState.LOST, T_odom_cam=None)
        registration.step(update)
        if n % 8 == 0:
            registration.accept(drive.fix(n, noisy=False))
    final = {t_ns // FRAME_NS: T for t_ns, T in registration.trajectory()}
    assert set(final) == set(range(120)) - {70}
    off_m = [np.linalg.norm(T[:3, 3] - drive.T_map_cam[n][:3, 3]) for n, T in final.items()]
    assert np.quantile(off_m, 0.9) < 0.02
