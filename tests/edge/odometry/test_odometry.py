# SPDX-License-Identifier: Apache-2.0
"""The odometry's life on drives through the corner: start, track, stop."""

from collections.abc import Callable

import numpy as np
import pytest

from edge.config.odometry import OdometryConfig
from edge.geometry import se3
from edge.odometry.odometry import Odometry
from edge.types import Frame, OdometryState
from tests.edge.odometry.drives import (
    CORNER,
    N_DRIVE,
    SETTLED,
    check_border,
    drive,
    error_m,
    normal_run,
    play,
    tracked,
)
from tests.edge.odometry.scenes import (
    FRAME_NS,
    MIDDLE,
    Corner,
    centres,
    forward,
    frames_along,
    rmse_after_similarity,
    sideways,
    turning,
    wandering,
)

# --- a drive without trouble ---


def test_a_drive_is_followed_from_its_start() -> None:
    updates = normal_run()
    first = tracked(updates)[0].index
    assert first < 15
    assert all(u.state is OdometryState.TRACKING for u in updates[first:])
    assert {u.odom_id for u in updates} == {1}
    assert error_m(updates) < 2e-3  # of 1.8 m of path, at 2.5 m depth


@pytest.mark.parametrize("delay", [0, 3, 8])
def test_late_keyframe_work_costs_little(delay: int) -> None:
    updates = play(drive(), OdometryConfig(keyframe_delay_frames=delay))
    assert len(tracked(updates)) > N_DRIVE - 25
    assert error_m(updates) < 6e-3
    chosen = {u.index: n for n, u in enumerate(updates) if u.is_keyframe}
    came = {
        u.keyframe.frame.index: n
        for n, u in enumerate(updates)
        if u.keyframe is not None and u.keyframe.frame.index in chosen
    }
    assert len(came) > 5
    assert {came[index] - chosen[index] for index in came} == {max(delay, 1)}


@pytest.mark.parametrize("way", [sideways, forward], ids=["sideways", "forward"])
def test_straight_ways_are_followed(way: Callable[[int], list[np.ndarray]]) -> None:
    poses = way(30)
    updates = play(frames_along(Corner(2), MIDDLE, poses))
    found = tracked(updates)
    assert len(found) > 15
    true = centres([poses[u.index] for u in found])
    length = np.linalg.norm(true[-1] - true[0])
    assert rmse_after_similarity(centres([u.T_odom_cam for u in found]), true) < 0.03 * length


def test_the_same_frames_give_the_same_bytes() -> None:
    for a, b in zip(normal_run(), play(drive()), strict=True):
        assert (a.index, a.state, a.odom_id, a.is_keyframe) == (
            b.index,
            b.state,
            b.odom_id,
            b.is_keyframe,
        )
        assert (a.T_odom_cam is None) == (b.T_odom_cam is None)
        if a.T_odom_cam is not None:
            assert a.T_odom_cam.tobytes() == b.T_odom_cam.tobytes()
            assert a.covariance.tobytes() == b.covariance.tobytes()
        if a.keyframe is not None:
            assert (
                a.keyframe.depth.inverse_depth.tobytes() == b.keyframe.depth.inverse_depth.tobytes()
            )


def test_updates_agree_with_themselves() -> None:
    poses_of = {}
    for update in normal_run():
        check_border(update)
        if update.keyframe is not None:
            poses_of[update.keyframe.frame.index] = update.keyframe.T_odom_cam
        if update.T_odom_cam is not None:
            T = poses_of[update.reference_index] @ update.T_reference_cam
            np.testing.assert_allclose(T, update.T_odom_cam, atol=1e-9)
            assert np.linalg.eigvalsh(update.covariance)[0] > 0
            assert not update.T_odom_cam.flags.writeable
            assert not update.covariance.flags.writeable


def test_keyframe_depths_are_right_and_their_sigma_honest() -> None:
    poses, z, errors = wandering(N_DRIVE), [], []
    for update in normal_run()[SETTLED:]:
        if update.keyframe is None:
            continue
        depth, index = update.keyframe.depth, update.keyframe.frame.index
        u, v = depth.pixels.T.astype(np.float64)
        true = 1.0 / CORNER.depth_at(MIDDLE, poses[index], u, v)
        ratio = depth.inverse_depth / true
        ratio /= np.median(ratio)
        errors.append(np.median(np.abs(ratio - 1.0)))
        z.append((ratio - 1.0) * depth.inverse_depth / depth.sigma)
    assert len(errors) > 8
    assert max(errors) < 0.04
    spread = 1.4826 * np.median(np.abs(np.concatenate(z)))
    assert 0.2 < spread < 4.0


def test_points_lie_on_the_walls() -> None:
    odometry = Odometry(MIDDLE)
    updates = [odometry.step(frame) for frame in drive()[:60]]
    xyz, grey = odometry.points()
    assert len(xyz) == len(grey) > 200
    poses = wandering(N_DRIVE)
    found = tracked(updates)
    ours, true = (
        centres([u.T_odom_cam for u in found]),
        centres([poses[u.index] for u in found]),
    )
    scale = np.linalg.norm(true - true.mean(0)) / np.linalg.norm(ours - ours.mean(0))
    last = found[-1]
    T_true_odom = poses[last.index] @ se3.inverse(last.T_odom_cam)
    seen = scale * (xyz @ T_true_odom[:3, :3].T) + (
        poses[last.index][:3, 3] - scale * T_true_odom[:3, :3] @ last.T_odom_cam[:3, 3]
    )
    assert np.median(np.abs(CORNER.distance_to_walls(seen))) < 0.03


# --- what is no motion ---


def test_a_still_camera_never_starts() -> None:
    frames = frames_along(Corner(3), MIDDLE, [np.eye(4)] * 30)
    assert {u.state for u in play(frames)} == {OdometryState.INITIALISING}


def test_turning_on_the_spot_keeps_tracking_but_never_starts() -> None:
    assert not tracked(play(frames_along(Corner(3), MIDDLE, turning(25))))
    poses = sideways(18)
    poses += [poses[-1] @ se3.exp([0, 0, 0, 0, 0.006 * n, 0]) for n in range(1, 30)]
    updates = play(frames_along(Corner(4), MIDDLE, poses))
    assert all(u.state is OdometryState.TRACKING for u in updates[17:])
    found = centres([u.T_odom_cam for u in updates[17:]])
    step = np.linalg.norm(updates[17].T_odom_cam[:3, 3] - updates[12].T_odom_cam[:3, 3]) / 5
    assert np.linalg.norm(found - found[0], axis=1).max() < 2.0 * step


def test_a_stop_is_no_trouble() -> None:
    still = [Frame(n, n * FRAME_NS, drive()[SETTLED].image) for n in range(SETTLED, SETTLED + 30)]
    updates = play((*drive()[:SETTLED], *still))
    assert all(u.state is OdometryState.TRACKING for u in updates[SETTLED:])
    found = centres([u.T_odom_cam for u in updates[SETTLED:]])
    assert np.linalg.norm(found - found[0], axis=1).max() < 5e-3
