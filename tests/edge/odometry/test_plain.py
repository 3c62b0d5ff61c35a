# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from edge.config.odometry import OdometryConfig
from edge.geometry import se3
from edge.image.pyramid import PyramidBuilder
from edge.odometry.plain import (
    PLAIN_SHARE,
    TEXTURED_SHARE,
    Smoother,
    noise_left,
    smoothing,
    strong_share,
)
from edge.odometry.reference import make_reference
from edge.odometry.tracker import Tracker
from edge.types import F32, U8
from tests.edge.odometry.scenes import MIDDLE, level_of, to_bytes

MASK = np.ones((180, 240), np.uint8)
DEPTH = 2.0
NOISE_GREY = 3.0
BAND = np.array([50, 110])  # rows


def striped(share: float) -> F32:
    """Level with one step of which so many pixels lie in strong gradients."""
    level = np.zeros((*MASK.shape, 3), np.float32)
    level.reshape(-1, 3)[: round(share * MASK.size), 1] = 20.0
    return level


def test_the_share_of_strong_gradients_is_counted_where_the_mask_allows() -> None:
    grey = np.full(MASK.shape, 90.0)
    grey[:, 120:] = 150.0  # central differences see the step from both sides
    assert strong_share(level_of(grey), MASK) == pytest.approx(2 * 178 / MASK.size)
    half = MASK.copy()
    half[90:] = 0
    assert strong_share(level_of(grey), half) == pytest.approx(2 * 89 / MASK.size)


def test_noise_on_a_bare_wall_is_no_texture() -> None:
    wall = to_bytes(np.full(MASK.shape, 120.0), NOISE_GREY).astype(np.float64)
    assert smoothing(level_of(wall), MASK) == 1.0


def test_smoothing_fades_with_texture() -> None:
    shares = np.linspace(0.0, 0.1, 21)
    found = [smoothing(striped(share), MASK) for share in shares]
    assert np.all(np.diff(found) <= 0.0)
    assert smoothing(striped(0.99 * PLAIN_SHARE), MASK) == 1.0
    assert smoothing(striped(1.01 * TEXTURED_SHARE), MASK) == 0.0
    between = 0.5 * (PLAIN_SHARE + TEXTURED_SHARE)
    assert smoothing(striped(between), MASK) == pytest.approx(0.5, abs=0.01)


@pytest.mark.parametrize("share", [0.0, 0.3, 0.7, 1.0])
def test_so_much_noise_is_left(share: float) -> None:
    noise = np.random.default_rng(1).normal(0.0, 10.0, (400, 400))
    smooth = Smoother().smoothed((level_of(noise),), share)[0][1:-1, 1:-1, 0]
    assert np.var(smooth) == pytest.approx(100.0 * noise_left(share), rel=0.02)


def test_only_a_copy_of_the_finest_level_is_smoothed() -> None:
    rng = np.random.default_rng(2)
    levels = [level_of(rng.normal(100.0, 20.0, (h, h))) for h in (64, 32)]
    before = [level.copy() for level in levels]
    finest, coarser = Smoother().smoothed(levels, 1.0)
    assert coarser is levels[1]
    assert np.array_equal(finest, level_of(finest[..., 0].astype(np.float64)))
    assert finest[1:-1, 1:-1, 0].std() < 0.5 * before[0][1:-1, 1:-1, 0].std()
    assert all(np.array_equal(a, b) for a, b in zip(levels, before, strict=True))
    assert Smoother().smoothed(levels, 0.0) is levels


def room(shift_px: float, seed: int) -> U8:
    """A wall with strong edges along x and a faint one across, moved by a part of a pixel."""
    rows, column = np.arange(180), np.arange(240) - (120.0 + shift_px)
    band = np.where((rows >= BAND[0]) & (rows < BAND[1]), 110.0, 180.0)
    grey = band[:, None] + 25.0 / (1.0 + np.exp(-column / 0.7))
    return to_bytes(grey, NOISE_GREY, seed)


def shift_found(seed: int, shift_px: float) -> tuple[float, float]:
    """By how much one frame was tracked to have moved along x, and its sigma [px]."""
    frames = PyramidBuilder(MIDDLE, 0, 4, 4)
    v, u = np.mgrid[6:174, 6:234:2].reshape(2, -1).astype(np.float32)
    near = np.abs(v[:, None] - BAND + 0.5).min(axis=1) < 3.0
    near |= np.abs(u - 120.0) < 4.0
    u, v = u[near], v[near]
    reference = make_reference(
        0, np.eye(4), np.zeros(2), frames.build(room(0.0, 2 * seed)), frames.masks,
        frames.pinholes, np.stack((u, v, np.full_like(u, 1.0 / DEPTH))), np.ones_like(u),
    )  # fmt: skip
    tracked = Tracker(frames.pinholes, frames.masks, OdometryConfig().resolved()).track(
        frames.build(room(shift_px, 2 * seed + 1)),
        reference,
        iter([se3.exp([shift_px * DEPTH / MIDDLE.fx, 0.0, 0.0, 0.0, 0.0, 0.0])]),
        np.zeros(2),
        NOISE_GREY,
    )
    middle = tracked.T_cam_reference @ [0.0, 0.0, DEPTH, 1.0]
    along = MIDDLE.fx * np.array([1.0 / DEPTH, 0.0, 0.0, 0.0, 1.0, 0.0])
    variance = along @ np.linalg.solve(tracked.information, along) * tracked.residual_grey**2
    return MIDDLE.fx * middle[0] / middle[2], float(np.sqrt(variance))


@pytest.mark.parametrize("shift_px", [0.3, -0.3])
def test_parts_of_pixels_are_told_where_only_a_faint_edge_holds(shift_px: float) -> None:
    """Without smoothing the noise draws them to half pixels, by 0.025 px here."""
    found = np.array([shift_found(seed, shift_px) for seed in range(40)])
    off, claimed = found[:, 0] - shift_px, found[:, 1]
    assert abs(off.mean()) < 0.017
    # ... and the poses are far less certain than they seem: 2.3 times.
    assert np.sqrt(np.mean(off**2)) < 1.5 * claimed.mean()
    assert np.sqrt(np.mean(off**2)) > 0.5 * claimed.mean()
