# SPDX-License-Identifier: Apache-2.0
"""Drives under a lamp that the camera carries."""

import numpy as np

from edge.types import Frame
from tests.edge.odometry.drives import N_DRIVE, drive, normal_run, play, tracked
from tests.edge.odometry.scenes import MIDDLE, centres, rmse_after_similarity, wandering


def under_a_lamp() -> list[Frame]:
    """The drive, lit as by a lamp beside the camera that swings a little."""
    v, u = np.mgrid[: MIDDLE.height, : MIDDLE.width]
    frames = []
    for frame in drive():
        middle = MIDDLE.width * (0.4 + 0.25 * np.sin(frame.index / 8.0)), 0.4 * MIDDLE.height
        near = np.exp(-((u - middle[0]) ** 2 + (v - middle[1]) ** 2) / (0.1 * MIDDLE.width**2))
        image = np.clip(np.rint(frame.image * (0.35 + 1.1 * near)), 0, 255).astype(np.uint8)
        frames.append(Frame(frame.index, frame.t_ns, image))
    return frames


def test_a_lamp_is_noticed_and_the_way_is_measured_without_its_light() -> None:
    updates = play(under_a_lamp())
    last = max(update.odom_id for update in updates)
    found = [update for update in tracked(updates) if update.odom_id == last]
    poses = wandering(N_DRIVE)
    mine = centres([u.T_odom_cam for u in found if u.T_odom_cam is not None])
    error_m = rmse_after_similarity(mine, centres([poses[u.index] for u in found]))
    assert last == 2
    assert len(found) > 30
    assert error_m < 0.03  # 0.24 by images as they are


def test_even_light_starts_nothing_anew() -> None:
    assert {update.odom_id for update in normal_run()} == {1}
