# SPDX-License-Identifier: Apache-2.0
"""Points and cameras of known place, for what triangulates."""

import numpy as np

from edge.geometry import se3
from edge.types import F64, Pinhole
from maps.fusion import Points, fuse
from maps.matching import MatchSide
from maps.settings import BuildSettings
from maps.tracks import Tracks

PINHOLE = Pinhole(640, 480, 500.0, 505.0, 320.0, 240.0)
EXACT = BuildSettings(pose_error=0.0)


class World:
    """Points seen by cameras on an arc, each feature with noise of its own."""

    def __init__(
        self,
        n_points: int = 300,
        n_views: int = 5,
        *,
        baseline: float = 0.3,
        noise_px: float = 0.0,
        octaves: int = 1,
        depth_sigma: float = 0.0,
        seed: int = 0,
    ) -> None:
        rng = np.random.default_rng(seed)
        low, high = (-0.8, -0.6, 3.0), (0.8, 0.6, 5.0)
        self.xyz = rng.uniform(low, high, (n_points, 3))
        steps = np.arange(n_views)
        self.poses = [
            se3.exp([x, 0.07 * x, 0.0, 0.01, -0.02 * i, 0.03 * i])
            for i, x in zip(steps, baseline * (steps - steps.mean()), strict=True)
        ]
        self.scale = 1.2 ** rng.integers(0, octaves, (n_views, n_points))
        self.sides = []
        for pose, scale in zip(self.poses, self.scale, strict=True):
            camera = self.xyz @ se3.inverse(pose)[:3, :3].T + se3.inverse(pose)[:3, 3]
            pixels = camera[:, :2] / camera[:, 2:] * (PINHOLE.fx, PINHOLE.fy)
            pixels += np.array((PINHOLE.cx, PINHOLE.cy))
            pixels += rng.normal(0.0, 1.0, pixels.shape) * noise_px * scale[:, None]
            depth = np.zeros(n_points)
            if depth_sigma > 0.0:
                depth = camera[:, 2] + rng.normal(0.0, depth_sigma, n_points)
            self.sides.append(_side(pixels, scale, depth, np.full(n_points, depth_sigma)))

    def tracks(self) -> Tracks:
        n, v = len(self.xyz), len(self.poses)
        return Tracks(
            np.arange(0, n * v + 1, v),
            np.tile(np.arange(v, dtype=np.int32), n),
            np.repeat(np.arange(n, dtype=np.int32), v),
        )

    def fused(self, settings: BuildSettings = EXACT) -> Points:
        return fuse(self.tracks(), self.poses, self.sides, settings)


def _side(pixels: F64, scale: F64, depth: F64, depth_sigma: F64) -> MatchSide:
    n = len(pixels)
    pixels32 = pixels.astype(np.float32)
    centre, focal = (PINHOLE.cx, PINHOLE.cy), (PINHOLE.fx, PINHOLE.fy)
    rays = np.column_stack(((pixels32.astype(np.float64) - centre) / focal, np.ones(n)))
    return MatchSide(
        PINHOLE,
        rays,
        pixels32,
        np.zeros((n, 4), np.uint64),
        np.zeros(n, np.float32),
        scale.astype(np.float32),
        depth,
        depth_sigma,
        np.zeros((2, n), np.int32),
    )
