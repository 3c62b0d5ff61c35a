# SPDX-License-Identifier: Apache-2.0
from collections.abc import Callable

import numpy as np
import pytest

from edge.config.odometry import OdometryConfig
from edge.geometry import se3
from edge.odometry.starter import Start, Starter
from edge.types import Frame, Mat4
from tests.edge.odometry.built_window import margin_mask
from tests.edge.odometry.scenes import (
    MIDDLE,
    Corner,
    centres,
    forward,
    frame_of,
    rmse_after_similarity,
    sideways,
    turning,
)

CONFIG = OdometryConfig().resolved()
BOTH = pytest.mark.parametrize("way", [sideways, forward], ids=["sideways", "forward"])


def new_starter() -> Starter:
    return Starter(MIDDLE.pinhole, margin_mask(), CONFIG)


def play(
    starter: Starter, corner: Corner, poses: list[Mat4], *, noise_grey: float = 1.0, first: int = 0
) -> Start | None:
    """The start that a drive gives, or None at its end."""
    for n, T in enumerate(poses):
        frame = frame_of(corner, MIDDLE, T, first + n, noise_grey)
        start = starter.step(frame, frame.image)
        if start is not None:
            return start
    return None


def depth_error(start: Start, corner: Corner, T_world_reference: Mat4) -> float:
    """Median relative error of the depths, after their common scale."""
    u, v = start.pixels.T.astype(np.float64)
    ratio = start.inverse_depth * corner.depth_at(MIDDLE, T_world_reference, u, v)
    return float(np.median(np.abs(ratio / np.median(ratio) - 1.0)))


@BOTH
def test_motion_starts_with_depths_as_certain_as_claimed(
    way: Callable[[int], list[Mat4]],
) -> None:
    poses, ratios = way(25), []
    for seed in range(4):
        corner = Corner(seed)
        start = play(new_starter(), corner, poses)
        assert start is not None
        assert start.max_relative_sigma < CONFIG.start_max_depth_sigma
        reference = poses[start.frames[0].index]
        ratios.append(depth_error(start, corner, reference) / start.max_relative_sigma)
        # Corners are found on whole pixels, and followed between them.
        assert np.array_equal(start.pixels, np.rint(start.pixels))
        # Its poses are those of its frames.
        found = centres([se3.inverse(T) for T in start.T_cam_reference])
        true = centres([poses[frame.index] for frame in start.frames])
        length = np.linalg.norm(true[-1] - true[0])
        assert rmse_after_similarity(found, true) < 0.15 * length
    # Of a normal error half lies within 0.67 sigma.
    assert np.median(ratios) < 0.8
    assert max(ratios) < 2.0


def test_slow_motion_starts_when_it_went_far_enough() -> None:
    start = play(new_starter(), Corner(0), sideways(60, step_m=0.003))
    assert start is not None
    assert start.frames[-1].index >= 8
    indices = [frame.index for frame in start.frames]
    assert indices == sorted(set(indices))


@pytest.mark.parametrize("noise_grey", [0.0, 1.0, 4.0])
def test_a_still_camera_never_starts(noise_grey: float) -> None:
    starter = new_starter()
    assert play(starter, Corner(1), [np.eye(4)] * 40, noise_grey=noise_grey) is None
    assert starter.has_reference


@pytest.mark.parametrize("step_rad", [0.004, 0.02])
@pytest.mark.parametrize("axis", [0, 1, 2], ids=["pitch", "yaw", "roll"])
def test_turning_on_the_spot_never_starts(axis: int, step_rad: float) -> None:
    turn = np.zeros(6)
    turn[3 + axis] = step_rad
    poses = [se3.exp(turn * (n - 12)) for n in range(25)]
    assert play(new_starter(), Corner(2), poses) is None


def test_motion_after_turning_starts() -> None:
    poses = turning(15)
    poses += [poses[-1] @ se3.exp([0.012 * n, 0, 0, 0, 0, 0]) for n in range(1, 30)]
    start = play(new_starter(), Corner(3), poses)
    assert start is not None
    assert start.frames[-1].index > 15
    assert depth_error(start, Corner(3), poses[start.frames[0].index]) < 0.06


def test_a_cut_takes_a_new_reference() -> None:
    starter = new_starter()
    assert play(starter, Corner(4), [np.eye(4)] * 3) is None
    start = play(starter, Corner(44), sideways(25), first=3)
    assert start is not None
    assert start.frames[0].index >= 3


def test_an_image_with_few_corners_gives_no_reference() -> None:
    starter = new_starter()
    blank = np.full((MIDDLE.height, MIDDLE.width), 90, np.uint8)
    blank[40:80, 50:120] = blank[100:140, 150:200] = 160  # eight are too few
    for n in range(3):
        assert starter.step(Frame(n, n, blank), blank) is None
        assert not starter.has_reference


def test_reset_forgets_the_reference() -> None:
    starter = new_starter()
    assert play(starter, Corner(5), [np.eye(4)] * 2) is None
    assert starter.has_reference
    starter.reset()
    assert not starter.has_reference


@pytest.mark.parametrize("gain", [0.5, 1.7])
def test_a_change_of_light_does_not_stop_the_start(gain: float) -> None:
    corner, starter = Corner(6, mean_grey=100.0, contrast_grey=22.0), new_starter()
    for n, T in enumerate(sideways(25)):
        grey = corner.image(MIDDLE, T) * (gain if n % 6 > 2 else 1.0)
        image = np.clip(np.rint(grey), 0, 255).astype(np.uint8)
        start = starter.step(Frame(n, n, image), image)
        if start is not None:
            break
    assert start is not None
    assert start.frames[0].index == 0


def test_the_same_frames_give_the_same_start() -> None:
    a = play(new_starter(), Corner(7), sideways(20))
    b = play(new_starter(), Corner(7), sideways(20))
    assert a is not None
    assert b is not None
    assert a.inverse_depth.tobytes() == b.inverse_depth.tobytes()
    assert np.stack(a.T_cam_reference).tobytes() == np.stack(b.T_cam_reference).tobytes()
