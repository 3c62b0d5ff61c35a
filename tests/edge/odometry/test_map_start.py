# SPDX-License-Identifier: Apache-2.0
"""Starts from depths that a map tells, in its units, also where images alone would not start."""

from collections.abc import Iterable

import numpy as np
import pytest

from edge.config.odometry import OdometryConfig
from edge.geometry import se3
from edge.image.pyramid import PyramidBuilder
from edge.odometry import kernels_window as kw
from edge.odometry.map_start import MapSeed
from edge.odometry.mapper import MappedKeyframe, Mapper
from edge.odometry.odometry import Odometry
from edge.types import (
    F64,
    DepthSamples,
    Frame,
    MapStart,
    Mat4,
    OdometryState,
    OdometryUpdate,
)
from tests.edge.odometry.scenes import (
    FRAME_NS,
    MIDDLE,
    Corner,
    centres,
    frames_along,
    rolling_image,
    to_bytes,
    turning,
    wandering,
)

CORNER = Corner(1)
CONFIG = OdometryConfig().resolved()
UNKNOWN = np.zeros(6)


def told(T_world_cam: Mat4, n: int = 300, factor: float = 1.0) -> DepthSamples:
    """Depths of a frame as a map tells them, a percent off each."""
    rng = np.random.default_rng(n)
    pixels = rng.uniform((8, 8), (MIDDLE.width - 9, MIDDLE.height - 9), (n, 2))
    depth = CORNER.depth_at(MIDDLE, T_world_cam, *pixels.T)
    inverse = factor / depth * np.exp(0.01 * rng.normal(size=n))
    return DepthSamples(*(a.astype(np.float32) for a in (pixels, inverse, 0.01 * inverse)))


def seed(frames: Iterable[Frame], depth: DepthSamples, velocity: F64 = UNKNOWN) -> MapSeed:
    return MapSeed(tuple(frames), MapStart(0, depth, velocity))


def started(
    poses: list[Mat4], depth: DepthSamples, velocity: F64 = UNKNOWN
) -> MappedKeyframe | None:
    mapper = Mapper(PyramidBuilder(MIDDLE, 0, 4, 1), CONFIG)
    return mapper.start_from_map(seed(frames_along(CORNER, MIDDLE, poses), depth, velocity), 1)


def play(poses: list[Mat4], seen_at: int, told_after: int) -> list[OdometryUpdate]:
    """A drive in which the map tells the depths of one frame so many frames later."""
    odometry, updates = Odometry(MIDDLE), []
    for frame in frames_along(CORNER, MIDDLE, poses):
        if frame.index == seen_at + told_after:
            odometry.begin_at(MapStart(seen_at, told(poses[seen_at]), UNKNOWN))
        updates.append(odometry.step(frame))
    return updates


def test_frames_since_then_are_followed_in_metres() -> None:
    poses = wandering(6)
    mapped = started(poses, told(poses[0]))
    assert mapped is not None
    assert mapped.result.in_map_units
    assert [pose.index for pose in mapped.result.followed] == [1, 2, 3, 4, 5]
    for pose in mapped.result.followed:
        T_true = se3.inverse(poses[0]) @ poses[pose.index]
        assert np.linalg.norm(pose.T_odom_cam[:3, 3] - T_true[:3, 3]) < 0.01


@pytest.mark.parametrize("known", [False, True])
def test_a_fast_camera_is_followed_as_the_map_tells_its_motion(known: bool) -> None:
    step = np.array([0.0, 0.0, 0.8, 0.0, -0.1, 0.0])  # a quarter of the depth
    poses = [se3.exp((k - 1) * step) for k in range(3)]
    velocity = step / (1e-9 * FRAME_NS) if known else UNKNOWN
    mapped = started(poses, told(poses[0]), velocity)
    if not known:
        assert mapped is None
        return
    assert mapped is not None
    for pose in mapped.result.followed:
        assert pose.T_odom_cam == pytest.approx(se3.exp(pose.index * step), abs=0.03)


def test_a_motion_wrongly_told_spoils_no_start() -> None:
    poses = wandering(6)
    right, other = (started(poses, told(poses[0]), v) for v in (UNKNOWN, np.full(6, 9.0)))
    assert right is not None
    assert other is not None
    for one, two in zip(right.result.followed, other.result.followed, strict=True):
        assert np.array_equal(one.T_odom_cam, two.T_odom_cam)


def test_the_unexposed_frame_of_an_image_is_left_out() -> None:
    poses, (left, right) = wandering(3), (40, MIDDLE.width - 40)
    u = np.arange(MIDDLE.width)
    lit = (u >= left) & (u < right)
    frames = tuple(
        Frame(f.index, f.t_ns, np.where(lit, f.image, np.uint8(2)))
        for f in frames_along(CORNER, MIDDLE, poses)
    )
    mapper = Mapper(PyramidBuilder(MIDDLE, 0, 4, 1), CONFIG)
    assert mapper.start_from_map(seed(frames, told(poses[0])), 1) is not None
    for table in (mapper.window.points, mapper.window.keyframes[0].candidates):
        assert table.shape[1] > 0
        assert table[kw.U].min() > left
        assert table[kw.U].max() < right


def test_few_depths_start_nothing() -> None:
    poses = wandering(4)
    assert started(poses, told(poses[0], 40)) is None


def test_frames_of_another_place_start_nothing() -> None:
    poses = wandering(4)
    elsewhere = [poses[0], *(T @ se3.exp([0, 0, 0, 0, 0.9, 0]) for T in poses[1:])]
    assert started(elsewhere, told(poses[0])) is None


@pytest.mark.parametrize("readout_s", [0.0, 0.03])
def test_rows_that_turn_far_against_each_other_start_nothing(readout_s: float) -> None:
    rate_rad_s = 1.0
    step = rate_rad_s * FRAME_NS * 1e-9
    poses = [T @ se3.exp([0, 0, 0, 0, step * k, 0]) for k, T in enumerate(wandering(4))]
    frames = []
    for k, T in enumerate(poses):
        image = rolling_image(CORNER, MIDDLE, T, rate_rad_s * (-1) ** k, readout_s)
        frames.append(Frame(k, k * FRAME_NS, to_bytes(image, 1.0, seed=k)))
    mapper = Mapper(PyramidBuilder(MIDDLE, 0, 4, 1), CONFIG)
    mapped = mapper.start_from_map(seed(frames, told(poses[0])), 1)
    assert (mapped is not None) == (readout_s == 0.0)


def test_how_the_first_keyframe_turned_is_known_once_frames_are_followed() -> None:
    poses = [T @ se3.exp([0, 0, 0, 0, 0.01 * k, 0]) for k, T in enumerate(wandering(4))]
    frames = tuple(frames_along(CORNER, MIDDLE, poses))
    mapper = Mapper(PyramidBuilder(MIDDLE, 0, 4, 1), CONFIG)
    assert mapper.start_from_map(seed(frames, told(poses[0])), 1) is not None
    T_1_0 = se3.inverse(poses[1]) @ poses[0]
    true = -se3.log(T_1_0)[3:] / (1e-9 * (frames[1].t_ns - frames[0].t_ns))
    assert mapper.window.keyframes[0].turning == pytest.approx(true, abs=0.05)


def test_a_drive_begins_with_the_map_and_keeps_its_unit() -> None:
    poses = wandering(45)
    updates = play(poses, seen_at=0, told_after=3)
    assert updates[3].state is not OdometryState.TRACKING
    assert all(u.state is OdometryState.TRACKING for u in updates[4:])
    found = centres([u.T_odom_cam for u in updates[4:]])
    true = centres([se3.inverse(poses[0]) @ T for T in poses[4:]])
    # 0.9 m of path, compared as it is.
    off = np.linalg.norm(found - true, axis=1).max()
    assert off < 0.03


@pytest.mark.parametrize("poses", [turning(20), [np.eye(4)] * 20], ids=["turning", "still"])
def test_no_parallax_is_needed(poses: list[Mat4]) -> None:
    updates = play(poses, seen_at=1, told_after=4)
    assert all(u.state is OdometryState.TRACKING for u in updates[6:])
    found = centres([u.T_odom_cam for u in updates[6:]])
    assert np.abs(found).max() < 0.05


@pytest.mark.parametrize("told_first", [False, True], ids=["under way", "told"])
def test_nothing_starts_from_a_map_that_is_no_longer_in_use(told_first: bool) -> None:
    odometry, states = Odometry(MIDDLE), []
    for frame in frames_along(CORNER, MIDDLE, [np.eye(4)] * 12):
        if frame.index == 3:
            odometry.begin_at(MapStart(1, told(np.eye(4)), UNKNOWN))
            if told_first:
                odometry.forget_map()
        states.append(odometry.step(frame).state)
        if frame.index == 3 and not told_first:
            odometry.forget_map()
    assert all(state is not OdometryState.TRACKING for state in states)


def test_a_frame_that_is_too_old_is_no_start() -> None:
    updates = play([np.eye(4)] * 20, seen_at=0, told_after=16)
    assert all(u.state is not OdometryState.TRACKING for u in updates)


@pytest.mark.parametrize("kind", ["few depths", "a frame long gone"])
def test_what_starts_nothing_does_not_delay_a_start_by_parallax(kind: str) -> None:
    poses = wandering(30)
    depth = told(poses[0], 40 if kind == "few depths" else 300)
    usual, odometry, states = Odometry(MIDDLE), Odometry(MIDDLE), []
    for frame in frames_along(CORNER, MIDDLE, poses):
        index = max(frame.index - 1, 0) if kind == "few depths" else -1
        odometry.begin_at(MapStart(index, depth, UNKNOWN))
        states.append((usual.step(frame).state, odometry.step(frame).state))
    assert states[-1][0] is OdometryState.TRACKING
    assert all(one is other for one, other in states)


def test_it_can_be_switched_off() -> None:
    odometry = Odometry(MIDDLE, OdometryConfig(start_from_map=False))
    for frame in frames_along(CORNER, MIDDLE, [np.eye(4)] * 8):
        odometry.begin_at(MapStart(frame.index - 1, told(np.eye(4)), UNKNOWN))
        assert odometry.step(frame).state is not OdometryState.TRACKING
