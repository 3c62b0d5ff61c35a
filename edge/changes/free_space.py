# SPDX-License-Identifier: Apache-2.0
"""Whether the map's images looked through a place: they saw what is behind it, nothing there."""

import numpy as np
from scipy.spatial import cKDTree

from edge.changes.depths import hull_of, slack_of, within
from edge.changes.seen_points import seen_points
from edge.geometry import se3
from edge.tiles.reader import Map
from edge.types import F64, I32, Bools

_NEAR_DEG = 25.0  # beside the live directions
_MAX_TIMES = 2.0  # the live distance
_MOST = 20  # images that are asked
_BEHIND = 8  # points, that must have been seen behind it in all
_IMAGES = 4  # so many of the images must have seen some; of what is behind single points, half
_THERE = 0.1  # as many as behind it, that may have been at its place
_GROWN_PX = 2.0
_FEW = 8  # images that are asked about single points
_ASKED = 4  # nearest of the depths that they know
_BESIDE_PX = 8.0
_KEPT = 64  # images whose depths are kept ready
_MARGIN = 0.01  # of the distance: errors of both


class MapRays:
    """Asks the map's keyframes. Owned by one thread."""

    def __init__(self, map_: Map) -> None:
        self._map = map_
        self._depths: dict[int, tuple[F64, F64]] = {}  # of keyframes that were asked

    def was_free(self, xyz: F64, cameras: F64) -> bool:
        """Whether the space of points (n, 3), now seen from `cameras` (m, 3), was seen through."""
        behind = there = images = 0
        for k in self._candidates(np.median(xyz, axis=0), cameras):
            deeper, at = self._ask(int(k), xyz)
            behind, there, images = behind + deeper, there + at, images + (deeper > 0)
        return behind >= _BEHIND and images >= _IMAGES and there <= _THERE * behind

    def are_free(self, xyz: F64, camera: F64) -> Bools:
        """Which points (n, 3), now seen from `camera` (3,), images saw through and none saw."""
        free, there = np.zeros(len(xyz), int), np.zeros(len(xyz), int)
        for k in self._candidates(np.median(xyz, axis=0), camera[None])[:_FEW]:
            pixels, depth = self._known(int(k))
            local = se3.transform(se3.inverse(self._map.pose(int(k))), xyz)
            ahead = np.flatnonzero(local[:, 2] > 1e-3)
            if len(depth) == 0 or len(ahead) == 0:
                continue
            at = self._pixels(int(k), local[ahead])
            _, rows = cKDTree(pixels).query(at, _ASKED, distance_upper_bound=_BESIDE_PX)
            ratio = np.append(depth, np.nan)[rows] / local[ahead, 2:]
            slack = slack_of(np.full(1, _MARGIN))[0]
            there[ahead] += (np.abs(ratio - 1.0) < slack).any(axis=1)
            free[ahead] += (ratio > 1.0 + slack).any(axis=1)
        sure: Bools = (there == 0) & (free >= _IMAGES // 2)
        return sure

    def _candidates(self, center: F64, cameras: F64) -> I32:
        """Keyframes that look from about there, the nearest first."""
        live = cameras - center
        reach = _MAX_TIMES * float(np.linalg.norm(live, axis=1).max())
        away = self._map.T_map_cam[:, :3, 3] - center
        distance = np.linalg.norm(away, axis=1)
        live /= np.linalg.norm(live, axis=1, keepdims=True)
        cosine = (away / np.maximum(distance, 1e-9)[:, None] @ live.T).max(axis=1)
        order = np.argsort(-cosine, kind="stable")
        alike = (distance < reach) & (cosine > np.cos(np.radians(_NEAR_DEG)))
        chosen: I32 = order[alike[order]][:_MOST].astype(np.int32)
        return chosen

    def _ask(self, k: int, xyz: F64) -> tuple[int, int]:
        """How many points keyframe `k` saw behind the space, and in it."""
        local = se3.transform(se3.inverse(self._map.pose(k)), xyz)
        if local[:, 2].min() < 1e-3:
            return 0, 0
        pixels, known = self._known(k)
        depth = known[within(hull_of(self._pixels(k, local), _GROWN_PX), pixels)]
        slack = slack_of(np.full(1, _MARGIN))[0]
        behind = depth > local[:, 2].max() * (1.0 + slack)
        at = ~behind & (depth > local[:, 2].min() * (1.0 - slack))
        return int(behind.sum()), int(at.sum())

    def _pixels(self, k: int, local: F64) -> F64:
        """Ideal pixels (n, 2) of points (n, 3) before keyframe `k`."""
        camera = self._map.cameras[int(self._map.keyframe_camera[k])].pinhole
        rays = local[:, :2] / local[:, 2:]
        pixels: F64 = rays * (camera.fx, camera.fy) + (camera.cx, camera.cy)
        return pixels

    def _known(self, k: int) -> tuple[F64, F64]:
        """Pixels (n, 2) of keyframe `k` at which depths (n,) are known."""
        if k not in self._depths:
            (features, xyz), samples = seen_points(self._map, k), self._map.depth_samples(k)
            of_points = se3.transform(se3.inverse(self._map.pose(k)), xyz)[:, 2]
            pixels = np.concatenate((features.pixels, samples.pixels)).astype(np.float64)
            given = 1.0 / samples.inverse_depth.astype(np.float64)
            if len(self._depths) >= _KEPT:
                del self._depths[next(iter(self._depths))]
            self._depths[k] = pixels, np.concatenate((of_points, given))
        return self._depths[k]
