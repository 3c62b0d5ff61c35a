# SPDX-License-Identifier: Apache-2.0
"""Frames from before the start get their poses afterwards."""

import numpy as np

from edge.types import KeyframePose, OdometryUpdate
from tests.edge.odometry.drives import check_border, drive, normal_run, play, tracked
from tests.edge.odometry.scenes import (
    FRAME_NS,
    MIDDLE,
    Corner,
    centres,
    frames_along,
    rmse_after_similarity,
    wandering,
)


def followed(updates: tuple[OdometryUpdate, ...] | list[OdometryUpdate]) -> list[KeyframePose]:
    return [pose for u in updates if u.keyframe is not None for pose in u.keyframe.followed]


def test_every_frame_before_the_start_gets_a_pose() -> None:
    updates, poses = normal_run(), wandering(len(drive()))
    first = tracked(updates)[0].index
    back = {pose.index: pose for pose in followed(updates)}
    assert len(back) == len(followed(updates))
    assert sorted(back) == list(range(first))
    assert all(pose.t_ns == index * FRAME_NS for index, pose in back.items())
    known = {u.index: u.T_odom_cam for u in tracked(updates)} | {
        index: pose.T_odom_cam for index, pose in back.items()
    }
    order = sorted(known)[:40]
    error = rmse_after_similarity(
        centres([known[k] for k in order]), centres([poses[k] for k in order])
    )
    assert error < 5e-3  # of 0.6 m of path, at 2.5 m depth


def test_frames_of_another_place_get_none() -> None:
    elsewhere = list(frames_along(Corner(9), MIDDLE, wandering(3)))
    frames = [*elsewhere, *drive()[3:40]]
    updates = play(frames)
    for update in updates:
        check_border(update)
    first = tracked(updates)[0].index
    assert first > 4
    assert {pose.index for pose in followed(updates)} == set(range(3, first))
    assert np.all(np.isfinite([pose.T_odom_cam for pose in followed(updates)]))
