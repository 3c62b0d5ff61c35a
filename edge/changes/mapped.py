# SPDX-License-Identifier: Apache-2.0
"""What the map's keyframes about the camera know of surfaces, and which space they saw through.

A keyframe knows depths here and there only. All together know surfaces closely, and free space.
"""

from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from edge.changes.cells import Keys, cell_keys, cell_means
from edge.changes.depths import places_of, seen_at
from edge.changes.seen_points import seen_points
from edge.config.changes import GeometryConfig
from edge.geometry import se3
from edge.tiles.reader import Map
from edge.types import F64, I32, Mat4, Pinhole

_MOST = 150  # keyframes
_STEP = 0.15  # of the range: so far the camera moves before they are chosen anew
_SURE_M, _VIEWS = 0.03, 3  # of points; less sure ones are of no surface
_NEAREST = 4  # depths of a keyframe that are asked about a place
_BESIDE_PX = 15.0  # at most


class _Rays(NamedTuple):
    """Depths that one keyframe knows."""

    T_map_cam: Mat4
    camera: Pinhole
    depth_m: F64  # (n,)
    xyz: F64  # (n, 3) [m]
    pixels: cKDTree  # (n, 2) ideal


class Mapped:
    """Surfaces of the map about the camera, as cells. Owned by one thread."""

    def __init__(self, map_: Map, settings: GeometryConfig) -> None:
        self._map, self._settings = map_, settings
        self._rays: dict[int, _Rays] = {}
        self._chosen_at: F64 | None = None
        self._all = cKDTree(np.empty((0, 3)))
        self.cells: Keys = np.empty(0, np.int64)  # (n,) in order
        self.xyz: F64 = np.empty((0, 3))  # the middle of what is known in each [m]

    def move_to(self, origin: F64) -> bool:
        """Take the keyframes about a place (3,); whether they are others than before."""
        reach_m = self._settings.range_m
        last = self._chosen_at
        if last is not None and np.linalg.norm(origin - last) < _STEP * reach_m:
            return False
        self._chosen_at = origin
        apart = np.linalg.norm(self._map.T_map_cam[:, :3, 3] - origin, axis=1)
        nearest = np.argsort(apart, kind="stable")[:_MOST]
        chosen = nearest[apart[nearest] < 2.0 * reach_m].tolist()
        if set(chosen) == self._rays.keys():
            return False
        self._rays = {k: self._rays.get(k) or self._read(k) for k in chosen}
        xyz = np.concatenate([np.empty((0, 3)), *(rays.xyz for rays in self._rays.values())])
        self._all = cKDTree(xyz)
        self.cells, self.xyz = cell_means(cell_keys(xyz, self._settings.cell_m), xyz)
        return True

    def distance(self, xyz: F64) -> F64:
        """How far (n,) places (n, 3) are from all that is known [m]."""
        if self._all.n == 0:
            return np.full(len(xyz), np.inf)
        return np.asarray(self._all.query(xyz)[0], np.float64)

    def seen_through(self, xyz: F64, towards: F64) -> tuple[I32, I32]:
        """How many depths lie behind each place (n, 3), and how many at it.

        Of those behind, only those seen from directions like `towards` (n, m, 3), zeros for none:
        what is thin hides nothing from its side.
        """
        behind, there = np.zeros(len(xyz), np.int32), np.zeros(len(xyz), np.int32)
        cell_m, cosine = self._settings.cell_m, np.cos(np.radians(self._settings.direction_deg))
        for rays in self._rays.values():
            pixels, depth = seen_at(rays.T_map_cam, xyz, rays.camera)
            rows = np.flatnonzero(np.isfinite(depth))
            if len(rows) == 0 or rays.pixels.n == 0:
                continue
            reach_px = np.minimum(cell_m / depth[rows] * rays.camera.fx, _BESIDE_PX)
            apart, near = rays.pixels.query(pixels[rows], _NEAREST, distance_upper_bound=_BESIDE_PX)
            further = np.append(rays.depth_m, np.nan)[near] - depth[rows, None]
            further[apart >= reach_px[:, None]] = np.nan
            away = rays.T_map_cam[:3, 3] - xyz[rows]
            away /= np.linalg.norm(away, axis=1, keepdims=True)
            alike = np.einsum("nmi,ni->nm", towards[rows], away).max(axis=1) > cosine
            behind[rows] += (further > cell_m).sum(axis=1) * alike
            there[rows] += (np.abs(further) <= cell_m).sum(axis=1)
        return behind, there

    def _read(self, k: int) -> _Rays:
        (features, xyz), samples = seen_points(self._map, k), self._map.depth_samples(k)
        camera = self._map.cameras[int(self._map.keyframe_camera[k])].pinhole
        T_map_cam = self._map.pose(k)
        known = self._map.points(features.point)
        sure = (known.n_views >= _VIEWS) & (
            np.sqrt(np.einsum("nii->n", known.covariance)) < _SURE_M
        )
        of_points = se3.transform(se3.inverse(T_map_cam), xyz[sure])[:, 2]
        pixels = np.concatenate((features.pixels[sure], samples.pixels)).astype(np.float64)
        given = 1.0 / samples.inverse_depth.astype(np.float64)
        depth = np.concatenate((of_points, given))
        places = places_of(pixels, depth, T_map_cam, camera)
        return _Rays(T_map_cam, camera, depth, places, cKDTree(pixels))
