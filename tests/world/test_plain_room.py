# SPDX-License-Identifier: Apache-2.0
from functools import cache
from itertools import count

import cv2
import numpy as np
import pytest

from edge.config.odometry import OdometryConfig
from edge.geometry import se3
from edge.geometry.camera import CameraModel
from edge.odometry.odometry import Odometry
from edge.types import F64, U8, Frame, LineSearch, Mat4, OdometryState
from tools.simworld.paths import make_path
from tools.simworld.renderer import Renderer
from tools.simworld.rooms import make_room
from tools.simworld.sensor import Sensor, capture

CAMERA = CameraModel(640, 480, 420.0, 420.0, 319.5, 239.5)
SEED, RATE_HZ, FRAMES = 6, 30.0, 18


@cache
def drive() -> tuple[list[U8], F64]:
    """Noisy grey images of a room of painted walls, and true poses."""
    room = make_room(SEED, "plain")
    path = make_path(room, 6202, 12.0, RATE_HZ)
    renderer, sensor = Renderer(room, CAMERA), Sensor(noise_grey=2.0, seed=SEED)
    images = [
        np.asarray(cv2.cvtColor(capture(renderer, path, k, sensor).bgr, cv2.COLOR_BGR2GRAY))
        for k in range(FRAMES)
    ]
    return images, path.T_world_cam


def tracked(images: list[U8], *, lines: bool) -> dict[int, Mat4]:
    odometry = Odometry(CAMERA, OdometryConfig(start_lines=lines))
    found = {}
    for k, image in enumerate(images):
        update = odometry.step(Frame(k, int(k * 1e9 / RATE_HZ), image))
        if update.state is OdometryState.TRACKING:
            assert update.T_odom_cam is not None
            found[k] = update.T_odom_cam
    return found


@pytest.mark.slow
def test_edges_start_where_corners_are_too_few() -> None:
    images, truth = drive()
    assert not tracked(images, lines=False)
    found = tracked(images, lines=True)
    assert len(found) >= 5
    first, last = min(found), max(found)
    moved = se3.inverse(found[first]) @ found[last]
    truly = se3.inverse(truth[first]) @ truth[last]
    cosine = moved[:3, 3] @ truly[:3, 3]
    cosine /= np.linalg.norm(moved[:3, 3]) * np.linalg.norm(truly[:3, 3])
    assert cosine > 0.9


@pytest.mark.slow
def test_searches_for_edges_are_told_with_their_frames() -> None:
    # One to begin and one to end each: every search takes a millisecond.
    config = OdometryConfig(window_lines=True)
    odometry = Odometry(CAMERA, config, clock=count(0, 1_000_000).__next__)
    starting: list[tuple[LineSearch, ...]] = []
    in_window: list[LineSearch] = []
    for k, image in enumerate(drive()[0]):
        update = odometry.step(Frame(k, int(k * 1e9 / RATE_HZ), image))
        if update.state is OdometryState.TRACKING:
            assert not update.line_searches  # only keyframes are searched then
        else:
            starting.append(update.line_searches)
        if update.keyframe is not None:
            in_window += update.keyframe.line_searches
    assert [len(searches) for searches in starting[:3]] == [1, 1, 1]
    assert len(in_window) >= 4  # the first window's keyframes
    for search in (*sum(starting, ()), *in_window):
        assert search.segments > 5
        assert search.ms == 1.0


@pytest.mark.slow
def test_standing_still_starts_nothing() -> None:
    image, rng = drive()[0][0], np.random.default_rng(1)
    noisy = [image + rng.normal(0.0, 2.0, image.shape) for _ in range(12)]
    assert not tracked([np.clip(n, 0, 255).astype(np.uint8) for n in noisy], lines=True)
