# SPDX-License-Identifier: Apache-2.0
"""A window of keyframes in the corner, at exact truth or moved off it."""

from collections.abc import Sequence

import numpy as np

from edge.config.odometry import OdometryConfig
from edge.geometry import se3
from edge.image.border import eroded
from edge.image.pyramid import MASK_MARGIN_PX, Pyramid
from edge.odometry import kernels_window as kw
from edge.odometry.candidates import CandidateSelector
from edge.odometry.keyframe import BRIGHTNESS_PRIOR
from edge.odometry.system import WindowSystem
from edge.odometry.window import Window
from edge.types import F64, U8, Frame, Mat4
from tests.edge.odometry.scenes import MIDDLE, Corner, level_of

POSES = [
    se3.exp([0.07 * i - 0.15, 0.02 * i * (-1) ** i, 0.03 * i, 0.01 * i, -0.02 * i, 0.015 * i])
    for i in range(5)
]


def margin_mask() -> U8:
    """Where a pattern may lie in an image without distortion."""
    return eroded(np.ones((MIDDLE.height, MIDDLE.width), np.uint8), MASK_MARGIN_PX)


def build_window(
    corner: Corner,
    poses: Sequence[Mat4] = tuple(POSES),
    brightness: Sequence[tuple[float, float]] | None = None,
    points_per_frame: int = 80,
    **config: float,
) -> Window:
    """All keyframes at their true poses, all points but the newest frame's at their true depths.

    brightness  (a, b) of each frame: it shows exp(a) times the corner's grey plus b
    """
    # The corner's waves look like edges and are none: here points alone are asked.
    settings = OdometryConfig(
        points=800, candidates=300, window_keyframes=7, window_lines=False, **config
    ).resolved()
    window = Window(MIDDLE.pinhole, margin_mask(), settings)
    affines = np.array(brightness if brightness is not None else np.zeros((len(poses), 2)))
    for n, (T, affine) in enumerate(zip(poses, affines, strict=True)):
        grey = np.exp(affine[0]) * corner.image(MIDDLE, T) + affine[1]
        frame = Frame(n, n, np.zeros((2, 2), np.uint8))
        window.add_keyframe(frame, Pyramid((level_of(grey),)), se3.inverse(T), affine)
    selector = CandidateSelector(window.mask, settings)
    for host, T in enumerate(poses[:-1]):
        level = window.images[window.keyframes[host].slot]
        table = selector.select(level, points_per_frame, host)
        depth = corner.depth_at(MIDDLE, T, *table[:2].astype(np.float64))
        table[kw.IDEPTH] = 1.0 / depth
        good = np.ones((len(poses), table.shape[1]), np.uint8)
        good[host] = 0
        window.add_points(table, np.full(table.shape[1], host, np.int32), good)
    return window


def reduced_system(window: Window) -> tuple[F64, F64]:
    """Normal equations (8 f, 8 f), (8 f,) of the frames: photometric, brightness and marginal."""
    system = WindowSystem(window.images, window.mask, window.intrinsics, window.config)
    packing = system.pack(window.points, window.host, window.residual, window.keyframes)
    system.linearise(packing, window.keyframes)
    H, b = system.reduced(packing, window.keyframes, 0.0)
    affines = np.stack([k.affine for k in window.keyframes])
    weights, values = np.zeros((len(affines), 8)), np.zeros((len(affines), 8))
    weights[:, 6:], values[:, 6:] = BRIGHTNESS_PRIOR, affines
    H = H + np.diag(weights.ravel()) + window.prior.H
    return H, b + (weights * values).ravel() + window.prior.gradient(window.keyframes)


def photometric_energy(window: Window) -> float:
    """Energy of all residuals at the current state."""
    system = WindowSystem(window.images, window.mask, window.intrinsics, window.config)
    packing = system.pack(window.points, window.host, window.residual, window.keyframes)
    return system.linearise(packing, window.keyframes)


def disturb(window: Window, seed: int, shift: float, turn: float, depth: float) -> None:
    """Move all poses but the first and all depths off the truth.

    shift, turn  deviation of each pose's translation and rotation [scene units, rad]
    depth        deviation of the logarithm of the depths
    """
    rng = np.random.default_rng(seed)
    for keyframe in window.keyframes[1:]:
        xi = rng.normal(0.0, np.repeat((shift, turn), 3))
        keyframe.T_first = se3.exp(xi) @ keyframe.T_first
    noise = np.exp(rng.normal(0.0, depth, window.points.shape[1]))
    window.points[kw.IDEPTH] *= noise.astype(np.float32)
