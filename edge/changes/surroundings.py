# SPDX-License-Identifier: Apache-2.0
"""What was measured around an image: what may hide things, and how far masks are."""

import numpy as np

from edge.changes.cover import between, grown, holds
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

    def __init__(self, map_: Map, camera: CameraModel, tolerance: float) -> None:
        """What is nearer by less than `tolerance`, a share of a depth, is not nearer."""
        self._camera, self._tolerance = camera, tolerance
        self._limit = (camera.width - 1.0, camera.height - 1.0)
        self._known = KnownSurface(map_)

    def look(self, look: Look) -> None:
        """Take the surfaces about an image; what is asked for is of this one."""
        self._T_cam_map = se3.inverse(look.T_map_cam)
        at = se3.transform(self._T_cam_map, look.surface)
        self._live_pixels, self._live_m = self._camera.project(at), at[:, 2]
        old = se3.transform(self._T_cam_map, self._known.about(look.T_map_cam))
        self._pixels = np.concatenate([self._live_pixels, self._camera.project(old)])
        self._depths_m = np.concatenate([self._live_m, old[:, 2]])

    def nearest_before(self, pixels: F64, depth_m: F64) -> F64:
        """Depth (n,) of the nearest thing measured about pixels (n, 2), before points seen there.

        NaN where none is surely nearer than the points' own depth (n,).
        """
        nearest = np.full(len(pixels), np.nan)
        rows = np.flatnonzero(between(pixels, (0.0, 0.0), self._limit))
        if len(rows) == 0:
            return nearest
        own, limit_m = pixels[rows], depth_m[rows] * (1.0 - self._tolerance)
        nearer = np.flatnonzero(self._depths_m < limit_m.max())
        low, high = own.min(axis=0) - _SURFACE_PX, own.max(axis=0) + _SURFACE_PX
        nearer = nearer[between(self._pixels[nearer], low, high)]
        if len(nearer) == 0:
            return nearest
        there, depths = self._pixels[nearer], self._depths_m[nearer]
        aside, below = (np.subtract.outer(own[:, axis], there[:, axis]) for axis in (0, 1))
        squared = aside * aside
        squared += below * below
        i, j = np.divmod(np.flatnonzero(squared.ravel() < _SURFACE_PX**2), len(there))
        # What things stand on comes nearer below them, and hides nothing.
        leaning = depths[j] * (1.0 + _LEANING * np.sqrt(squared[i, j]) / self._camera.fx)
        least = np.full(len(own), np.inf)
        np.minimum.at(least, i, leaning)
        nearest[rows] = np.where(least < limit_m, least, np.nan)
        return nearest

    def range_of(self, mask: Mask) -> tuple[float, float]:
        """Depth of what a mask holds, as measured live, and its deviation [m]; NaN if unknown."""
        near = np.flatnonzero(holds(grown(mask, _OUTLINE_PX), self._live_pixels))
        around = self._live_m[near]
        inside = around[holds(mask, self._live_pixels[near])]
        if len(around) == 0:
            return float("nan"), float("nan")
        # Of what is plain, its outline is measured; what stands before or behind may be, too.
        around = np.sort(around)
        (middle,) = _quantiles(np.sort(inside) if len(inside) >= _MANY_DEPTHS else around, 0.5)
        low, high = _quantiles(around, 0.1, 0.9)
        sigma = float(np.hypot(_DEPTH_SIGMA * middle, 0.5 * (high - low)))
        return middle, sigma if len(around) > 1 else _ONE_SIGMA * middle


def _quantiles(ordered: F64, *shares: float) -> list[float]:
    """As np.quantile, which takes twenty times as long for a few numbers."""
    last = len(ordered) - 1
    quantiles: list[float] = np.interp(
        [share * last for share in shares], np.arange(last + 1), ordered
    ).tolist()
    return quantiles
