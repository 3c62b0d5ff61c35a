# SPDX-License-Identifier: Apache-2.0
"""What was measured around an image: what may hide things, and how far masks are."""

import numpy as np

from edge.changes.cover import grown, holds
from edge.changes.known_surface import KnownSurface
from edge.geometry import se3
from edge.geometry.camera import CameraModel
from edge.tiles.reader import Map
from edge.types import F64, Look, Mask

_LEANING = 2.0  # depth over a step aside, on what leans most
_SURFACE_PX = 14.0  # a depth tells what is about so far around it
_OUTLINE_PX = 4
_MANY_DEPTHS = 3
_DEPTH_SIGMA, _ONE_SIGMA = 0.05, 0.15  # of a depth; of one alone


class Surroundings:
    """The surfaces about one image after another, by map and odometry. Owned by one thread."""

    def __init__(self, map_: Map, camera: CameraModel) -> None:
        self._camera = camera
        self._known = KnownSurface(map_)

    def look(self, look: Look) -> None:
        """Take the surfaces about an image; what is asked for is of this one."""
        self._T_cam_map = se3.inverse(look.T_map_cam)
        at = se3.transform(self._T_cam_map, look.surface)
        self._live_pixels, self._live_m = self._camera.project(at), at[:, 2]
        old = se3.transform(self._T_cam_map, self._known.about(look.T_map_cam))
        self._pixels = np.concatenate([self._live_pixels, self._camera.project(old)])
        self._depths_m = np.concatenate([self._live_m, old[:, 2]])

    def nearest_over(self, points: F64) -> F64:
        """Depth (n,) of the nearest thing measured about where points lie; NaN where none is."""
        nothing = np.full(len(points), np.nan)
        pixels, depths = self._pixels, self._depths_m
        own = self._camera.project(se3.transform(self._T_cam_map, points))
        if len(depths) == 0 or not np.isfinite(own).all(axis=1).any():
            return nothing
        low, high = np.nanmin(own, axis=0) - _SURFACE_PX, np.nanmax(own, axis=0) + _SURFACE_PX
        near = ((pixels >= low) & (pixels <= high)).all(axis=1)
        if not near.any():
            return nothing
        apart = np.linalg.norm(own[:, None] - pixels[near][None], axis=2)
        # What things stand on comes nearer below them, and hides nothing.
        leaning = depths[near] * (1.0 + _LEANING * apart / self._camera.fx)
        depth = np.where(apart < _SURFACE_PX, leaning, np.inf).min(axis=1)
        surface: F64 = np.where(np.isfinite(depth), depth, np.nan)
        return surface

    def range_of(self, mask: Mask) -> tuple[float, float]:
        """Depth of what a mask holds, as measured live, and its deviation [m]; NaN if unknown."""
        inside = self._live_m[holds(mask, self._live_pixels)]
        around = self._live_m[holds(grown(mask, _OUTLINE_PX), self._live_pixels)]
        if len(around) == 0:
            return float("nan"), float("nan")
        # Of what is plain, its outline is measured; what stands before or behind may be, too.
        middle = float(np.median(inside if len(inside) >= _MANY_DEPTHS else around))
        low, high = np.percentile(around, (10, 90))
        sigma = float(np.hypot(_DEPTH_SIGMA * middle, 0.5 * (high - low)))
        return middle, sigma if len(around) > 1 else _ONE_SIGMA * middle
