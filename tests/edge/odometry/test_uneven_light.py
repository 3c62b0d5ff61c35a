# SPDX-License-Identifier: Apache-2.0
"""Drives under a lamp that the camera carries."""

import itertools
from collections.abc import Sequence

import numpy as np

from edge.image.shade import gain_by_cells
from edge.odometry.uneven_light import gain_by_evening
from edge.odometry.window_points import project
from edge.types import F64, Frame, Mat4, OdometryUpdate, Pinhole
from tests.edge.odometry.built_window import build_window
from tests.edge.odometry.drives import N_DRIVE, drive, normal_run, play, tracked
from tests.edge.odometry.scenes import MIDDLE, Corner, centres, rmse_after_similarity, wandering


class LitCorner(Corner):
    """The corner, in each image under a lamp that stands elsewhere in it."""

    def __init__(self, seed: int, brightness: float) -> None:
        super().__init__(seed)
        self._brightness, self._images = brightness, itertools.count()

    def image(self, camera: Pinhole, T_world_cam: Mat4) -> F64:  # type: ignore[override]
        """Its grey (h, w)."""
        v, u = np.mgrid[: camera.height, : camera.width]
        middle = camera.width * (0.15 + 0.17 * next(self._images)), 0.5 * camera.height
        near = np.exp(-((u - middle[0]) ** 2 + (v - middle[1]) ** 2) / (0.1 * camera.width**2))
        return np.asarray(super().image(camera, T_world_cam) * (1.0 + self._brightness * near))


def gain_under(brightness: float, *, mixed_up: bool = False) -> float:
    """Of a window at exact truth; `mixed_up` gives each host the newest keyframe's lamp."""
    window = build_window(LitCorner(1, brightness))
    images = [window.images[k.slot][..., 0] for k in window.keyframes]
    gains = [gain_by_cells(images[-1] if mixed_up else image, window.mask) for image in images]
    gain = gain_by_evening(window, project(window), gains)
    assert gain is not None
    return gain


def test_points_look_alike_without_lamps_that_moved() -> None:
    assert gain_under(0.0) < 0.0
    assert gain_under(2.0) > 1.0
    # The light of each keyframe is its own.
    assert gain_under(2.0, mixed_up=True) < 0.5


def under_a_lamp(swing: float) -> list[Frame]:
    """The drive, lit as by a lamp beside the camera that swings a little."""
    v, u = np.mgrid[: MIDDLE.height, : MIDDLE.width]
    frames = []
    for frame in drive():
        middle = MIDDLE.width * (0.4 + swing * np.sin(frame.index / 8.0)), 0.4 * MIDDLE.height
        near = np.exp(-((u - middle[0]) ** 2 + (v - middle[1]) ** 2) / (0.06 * MIDDLE.width**2))
        image = np.clip(np.rint(frame.image * (0.4 + 1.4 * near)), 0, 255).astype(np.uint8)
        frames.append(Frame(frame.index, frame.t_ns, image))
    return frames


def test_a_lamp_is_noticed_and_the_way_is_measured_without_its_light() -> None:
    updates = play(under_a_lamp(0.25))
    last = max(update.odom_id for update in updates)
    found = [update for update in tracked(updates) if update.odom_id == last]
    assert last == 2
    assert len(found) > 30  # 18 by images as they are, which lose the way in between
    assert error_m(found) < 0.06


def test_where_a_lamp_hardly_drew_along_the_odometry_goes_on() -> None:
    updates = play(under_a_lamp(0.03))
    assert {update.odom_id for update in updates} == {1}
    assert len(tracked(updates)) > 100
    assert error_m(tracked(updates)) < 0.04


def error_m(found: Sequence[OdometryUpdate]) -> float:
    """Of the places, after the best similarity."""
    poses = wandering(N_DRIVE)
    mine = centres([u.T_odom_cam for u in found if u.T_odom_cam is not None])
    return rmse_after_similarity(mine, centres([poses[u.index] for u in found]))


def test_even_light_starts_nothing_anew() -> None:
    assert {update.odom_id for update in normal_run()} == {1}
