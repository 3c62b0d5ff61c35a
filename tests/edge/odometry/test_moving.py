# SPDX-License-Identifier: Apache-2.0
"""What lies under masks of moving things leaves the odometry, and comes back when they are gone."""

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest

from edge.geometry import se3
from edge.odometry.odometry import Odometry
from edge.types import F64, Frame, Mask, Moving, OdometryUpdate
from tests.edge.odometry.drives import N_DRIVE, drive, error_m, tracked
from tests.edge.odometry.scenes import MIDDLE, wandering

pytestmark = pytest.mark.slow

LATE = 4  # frames until masks come
EVERY = 4
N_FRAMES = 70
ON_WALL = se3.transform(wandering(N_DRIVE)[N_FRAMES - 1], np.array([[0.0, 0.0, 2.5]]))[0]
MARGIN_PX = 12
REVERSED_NS = 3_600_000_000_000


def border_px(index: int) -> int:
    """Column of a place on the wall, in a frame."""
    T_cam_world = se3.inverse(wandering(N_DRIVE)[index])
    column = MIDDLE.project(se3.transform(T_cam_world, ON_WALL[None]))[0, 0]
    return int(np.clip(column, 0, MIDDLE.width - 1))


def mask_right(frame: Frame) -> Moving:
    """As if all that lies to the right of that place moved."""
    left = border_px(frame.index)
    inside = np.ones((MIDDLE.height, MIDDLE.width - left), dtype=bool)
    return Moving(frame.index, frame.t_ns, (Mask(left, 0, inside),))


def mask_nothing(frame: Frame) -> Moving:
    return Moving(frame.index, frame.t_ns, ())


def mask_late(frame: Frame) -> Moving:
    """As if it had come into view: a mask of before must not count for what came after."""
    return mask_right(frame) if frame.index >= N_FRAMES - 14 else mask_nothing(frame)


def play(
    odometry: Odometry, moving: Callable[[Frame], Moving] | None, *, in_reverse: bool = False
) -> list[OdometryUpdate]:
    frames, updates = drive()[:N_FRAMES], []
    if in_reverse:  # as its stamps would be
        frames = [dataclasses.replace(frame, t_ns=REVERSED_NS - frame.t_ns) for frame in frames]
    for i, frame in enumerate(frames):
        updates.append(odometry.step(frame))
        if moving is not None and i >= LATE and i % EVERY == 0:
            odometry.hide(moving(frames[i - LATE]))
    return updates


def share_on_the_right(odometry: Odometry, update: OdometryUpdate) -> float:
    """Share of the points in the image that lie well to the right of that place."""
    xyz, _ = odometry.points()
    assert update.T_odom_cam is not None
    pixels: F64 = MIDDLE.project(se3.transform(se3.inverse(update.T_odom_cam), xyz.astype(float)))
    inside = (pixels >= 0.0).all(axis=1) & (pixels < (MIDDLE.width, MIDDLE.height)).all(axis=1)
    return float((pixels[inside, 0] > border_px(update.index) + MARGIN_PX).mean())


def test_nothing_is_measured_under_masks_and_the_rest_is_followed_on() -> None:
    free, masked = Odometry(MIDDLE), Odometry(MIDDLE)

    usual, updates = play(free, None), play(masked, mask_right)

    shares = share_on_the_right(free, usual[-1]), share_on_the_right(masked, updates[-1])
    assert shares[0] > 0.08
    assert shares[1] < 0.25 * shares[0]
    assert len(tracked(updates)) > 0.9 * len(tracked(usual))
    assert error_m(updates) < 0.03  # by half of what is seen; with all, below 0.002


def test_masks_are_of_the_same_frames_when_a_recording_is_played_in_reverse() -> None:
    onward, in_reverse = Odometry(MIDDLE), Odometry(MIDDLE)

    play(onward, mask_late)
    play(in_reverse, mask_late, in_reverse=True)

    assert len(onward.points()[0]) == len(in_reverse.points()[0])  # of the same images


def test_images_without_anything_that_moves_change_nothing() -> None:
    usual, updates = play(Odometry(MIDDLE), None), play(Odometry(MIDDLE), mask_nothing)

    for one, other in zip(usual, updates, strict=True):
        if one.T_odom_cam is None or other.T_odom_cam is None:
            assert one.T_odom_cam is other.T_odom_cam
        else:
            np.testing.assert_array_equal(one.T_odom_cam, other.T_odom_cam)


def test_masks_of_a_frame_that_was_not_tracked_are_no_use() -> None:
    odometry = Odometry(MIDDLE)
    updates = play(odometry, None)
    before = len(odometry.points()[0])

    odometry.hide(mask_right(drive()[0]))
    odometry.hide(Moving(10_000, 0, ()))
    assert len(odometry.points()[0]) == before

    odometry.hide(mask_right(drive()[N_FRAMES - 1]))
    assert len(odometry.points()[0]) < before
    assert share_on_the_right(odometry, updates[-1]) < 0.02
