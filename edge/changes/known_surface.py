# SPDX-License-Identifier: Apache-2.0
"""Surfaces that the map's own images measured about where the camera looks now."""

from collections import OrderedDict

import numpy as np

from edge.changes.seen_points import seen_points
from edge.geometry import se3
from edge.tiles.reader import Map
from edge.types import F64, Mat4

_KEYFRAMES = 3  # that look most alike
_NEAR_M, _NEAR_DEG = 1.5, 40.0
_KEPT = 64  # keyframes
_SURE = 0.1  # deviation of a depth, as a share of it


class KnownSurface:
    """Asks the map's keyframes for what stands before things. Owned by one thread."""

    def __init__(self, map_: Map) -> None:
        self._map = map_
        self._points: OrderedDict[int, F64] = OrderedDict()

    def about(self, T_map_cam: Mat4) -> F64:
        """Places (n, 3) in the map [m] of what keyframes saw that look like this camera."""
        poses = self._map.T_map_cam
        apart = np.linalg.norm(poses[:, :3, 3] - T_map_cam[:3, 3], axis=1) / _NEAR_M
        cosine = np.clip(poses[:, :3, 2] @ T_map_cam[:3, 2], -1.0, 1.0)
        cost = apart + np.degrees(np.arccos(cosine)) / _NEAR_DEG
        order = np.argsort(cost, kind="stable")[:_KEYFRAMES]
        near = [self._of(int(k)) for k in order[cost[order] < 2.0]]
        return np.concatenate([np.empty((0, 3)), *near])

    def _of(self, k: int) -> F64:
        if k in self._points:
            self._points.move_to_end(k)
        else:
            self._points[k] = self._read(k)
            if len(self._points) > _KEPT:
                self._points.popitem(last=False)
        return self._points[k]

    def _read(self, k: int) -> F64:
        samples = self._map.depth_samples(k)
        camera = self._map.cameras[int(self._map.keyframe_camera[k])].pinhole
        sure = samples.sigma < _SURE * samples.inverse_depth
        pixels = samples.pixels[sure].astype(np.float64)
        rays = np.column_stack(
            [(pixels - (camera.cx, camera.cy)) / (camera.fx, camera.fy), np.ones(len(pixels))]
        )
        local = rays / samples.inverse_depth[sure][:, None].astype(np.float64)
        _, points = seen_points(self._map, k)
        return np.concatenate([se3.transform(self._map.pose(k), local), points])
