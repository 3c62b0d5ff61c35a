# SPDX-License-Identifier: Apache-2.0
"""What the odometry does with images that show no drive, or a spoiled one."""

from collections import Counter
from collections.abc import Callable

import numpy as np
import pytest

from edge.config.odometry import OdometryConfig
from edge.types import U8, Frame, OdometryState
from tests.edge.odometry.drives import N_DRIVE, SETTLED, check_border, drive, error_m, play, tracked
from tests.edge.odometry.scenes import FRAME_NS, MIDDLE, Corner, wandering

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


def test_a_black_frame_around_the_image_does_not_hold_the_poses() -> None:
    v, u = np.mgrid[: MIDDLE.height, : MIDDLE.width]
    lit = (u > 30) & (u < 205) & (v > 25) & (v < 155)
    frames = [Frame(f.index, f.t_ns, np.where(lit, f.image, np.uint8(2))) for f in drive()]
    updates = play(frames)
    assert {u.odom_id for u in updates} == {1}
    assert len(tracked(updates)) > N_DRIVE - 25
    assert error_m(updates) < 6e-3
