# SPDX-License-Identifier: Apache-2.0
"""The odometry's life on drives through the corner: start, track, lose, start again."""

from collections import Counter
from collections.abc import Callable, Iterable
from functools import cache

import numpy as np
import pytest

from edge.config.odometry import OdometryConfig
from edge.geometry import se3
from edge.geometry.camera import CameraModel
from edge.odometry.odometry import Odometry
from edge.types import U8, Frame, OdometryState, OdometryUpdate
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

N_DRIVE = 110
SETTLED = 30  # by then the drive is tracked for long
CORNER = Corner(1)


@cache
def drive() -> tuple[Frame, ...]:
    return tuple(frames_along(CORNER, MIDDLE, wandering(N_DRIVE)))


def play(
    frames: Iterable[Frame], config: OdometryConfig | None = None, camera: CameraModel = MIDDLE
) -> list[OdometryUpdate]:
    odometry = Odometry(camera, config)
    return [odometry.step(frame) for frame in frames]


@cache
def normal_run() -> tuple[OdometryUpdate, ...]:
    return tuple(play(drive()))


def tracked(updates: Iterable[OdometryUpdate]) -> list[OdometryUpdate]:
    return [u for u in updates if u.T_odom_cam is not None]


def error_m(updates: Iterable[OdometryUpdate]) -> float:
    """RMSE of the tracked frames' positions after the best similarity."""
    poses, found = wandering(N_DRIVE), tracked(updates)
    return rmse_after_similarity(
        centres([u.T_odom_cam for u in found]), centres([poses[u.index] for u in found])
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


def check_border(update: OdometryUpdate) -> None:
    """What holds of every update, whatever was seen."""
    has_pose = update.state is OdometryState.TRACKING and update.T_odom_cam is not None
    assert has_pose == (update.T_odom_cam is not None)
    assert 0.0 <= update.quality <= 1.0
    if has_pose:
        assert np.all(np.isfinite(update.T_odom_cam))
        assert np.all(np.isfinite(update.covariance))
        R = update.T_odom_cam[:3, :3]
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-9)
    if update.keyframe is not None:
        depth = update.keyframe.depth
        assert len(depth.pixels) == len(depth.inverse_depth) == len(depth.sigma)
        assert np.all(np.isfinite(depth.pixels))
        assert np.all(depth.inverse_depth > 0)
        assert np.all(np.isfinite(depth.sigma))
        assert np.all(depth.sigma > 0)
        assert all(np.all(np.isfinite(k.T_odom_cam)) for k in update.keyframe.window)


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


# --- trouble ---

RNG = np.random.default_rng(0)
SIZE = (MIDDLE.height, MIDDLE.width)
SPOILED: dict[str, Callable[[U8], U8]] = {
    "noise": lambda image: RNG.integers(0, 256, SIZE, np.uint8),
    "black": np.zeros_like,
    "white": lambda image: np.full_like(image, 255),
    "another place": lambda image: np.ascontiguousarray(drive()[-1].image[::-1, ::-1]),
    "turned by a quarter": lambda image: np.ascontiguousarray(
        np.rot90(np.pad(image, ((30, 30), (0, 0)), mode="reflect"))[30:-30]
    ),
}


def spoiled(name: str, start: int, count: int) -> list[Frame]:
    """The drive with some frames replaced."""
    frames = list(drive())
    for n in range(start, start + count):
        frames[n] = Frame(n, frames[n].t_ns, SPOILED[name](frames[n].image))
    return frames


@pytest.mark.parametrize("name", SPOILED)
def test_a_blink_is_no_loss(name: str) -> None:
    updates = play(spoiled(name, SETTLED + 10, 2))
    for update in updates:
        check_border(update)
    gone = updates[SETTLED + 10 : SETTLED + 12]
    assert {u.state for u in gone} == {OdometryState.LOST}
    assert not any(u.is_keyframe for u in gone)
    assert all(u.state is OdometryState.TRACKING for u in updates[SETTLED + 12 :])
    assert {u.odom_id for u in updates} == {1}
    assert error_m(updates) < 6e-3


@pytest.mark.parametrize("name", [name for name in SPOILED if "turned" not in name])
def test_after_a_loss_poses_come_under_a_new_id_only(name: str) -> None:
    updates = play(spoiled(name, SETTLED + 10, 12))
    for update in updates:
        check_border(update)
    gone = updates[SETTLED + 10 : SETTLED + 22]
    assert not tracked(gone)
    assert OdometryState.LOST in {u.state for u in gone}
    last_good = updates[SETTLED + 9]
    assert last_good.odom_id == 1
    after = tracked(updates[SETTLED + 22 :])
    assert len(after) > 12
    assert {u.odom_id for u in after} == {2}
    ids = [u.odom_id for u in updates]
    assert ids == sorted(ids)
    # No keyframe of the first life comes up in the second.
    for update in after:
        assert update.reference_index >= SETTLED + 10
        if update.keyframe is not None:
            assert all(k.index >= SETTLED + 10 for k in update.keyframe.window)
    assert error_m(after) < 8e-3


@pytest.mark.parametrize("delay", [1, 12])
def test_results_of_a_lost_life_are_void(delay: int) -> None:
    # With 12 frames of delay, keyframes of the first life come back after its end.
    config = OdometryConfig(keyframe_delay_frames=delay, max_failures=2)
    updates = play(spoiled("noise", SETTLED + 10, 6), config)
    second = tracked(updates[SETTLED + 10 :])
    assert second
    assert {u.odom_id for u in second} == {2}
    assert all(u.reference_index >= SETTLED + 10 for u in second)


def half_black(image: U8) -> U8:
    image = image.copy()
    image[:, : image.shape[1] // 2] = 0
    return image


def test_a_covered_half_is_lost_or_right_but_never_wrong() -> None:
    frames = list(drive())
    for n in range(SETTLED + 10, SETTLED + 13):
        frames[n] = Frame(n, frames[n].t_ns, half_black(frames[n].image))
    updates = play(frames)
    for update in updates:
        check_border(update)
    assert all(u.state is OdometryState.TRACKING for u in updates[SETTLED + 20 :])
    assert {u.odom_id for u in updates} == {1}
    assert error_m(updates) < 8e-3


@pytest.mark.parametrize("seed", range(3))
def test_no_images_can_make_it_fail_or_say_nan(seed: int) -> None:
    rng = np.random.default_rng(seed)
    names = ["as it is", "as it is", "as it is", "again", "half black", *SPOILED]
    frames, counts = [], Counter[str]()
    while len(frames) < 90:
        name, length = rng.choice(names), int(rng.integers(1, 9))
        counts[name] += 1
        for n in range(len(frames), len(frames) + length):
            image = drive()[n].image
            if name == "again" and frames:
                image = frames[-1].image
            elif name == "half black":
                image = half_black(image)
            elif name in SPOILED:
                image = SPOILED[name](image)
            frames.append(Frame(n, n * FRAME_NS, image))
    updates = play(frames)
    for update in updates:
        check_border(update)
    ids = [u.odom_id for u in updates]
    assert ids == sorted(ids)
    assert len(updates) == len(frames)


def test_nothing_but_noise_never_starts() -> None:
    rng = np.random.default_rng(1)
    noise = [Frame(n, n, rng.integers(0, 256, SIZE, np.uint8)) for n in range(20)]
    assert not tracked(play(noise))


def test_a_covered_lens_waits() -> None:
    dark = [Frame(n, n, np.full(SIZE, 7, np.uint8)) for n in range(5)]
    assert {u.state for u in play(dark)} == {OdometryState.WAITING}


@pytest.mark.parametrize("name", ["gain", "steps"])
def test_changing_light_is_no_trouble(name: str) -> None:
    corner, poses = Corner(5, mean_grey=100.0, contrast_grey=25.0), wandering(N_DRIVE)
    frames = []
    for n, T in enumerate(poses):
        wave = 0.3 * np.sin(n / 3.0) if name == "gain" else 0.3 * (n % 16 > 7)
        grey = np.exp(wave) * corner.image(MIDDLE, T) + 8.0 * np.sin(n / 5.0)
        frames.append(Frame(n, n * FRAME_NS, np.clip(np.rint(grey), 0, 255).astype(np.uint8)))
    updates = play(frames)
    assert {u.odom_id for u in updates} == {1}
    assert len(tracked(updates)) > N_DRIVE - 25
    assert error_m(updates) < 8e-3
