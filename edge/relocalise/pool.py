# SPDX-License-Identifier: Apache-2.0
"""What some keyframes of the map hold, put together for matching."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from edge.relocalise.lens import magnification
from edge.tiles.reader import NO_POINT, Map
from edge.types import F32, F64, I32

U64 = NDArray[np.uint64]


class Pool(NamedTuple):
    """Observations (m rows) of n map points in k keyframes."""

    keyframes: I32  # (k,) of the map
    descriptors: U64  # (m, 4)
    ray: F64  # (m, 3) unit vector from the camera that saw it to the point
    axis: F64  # (m, 3) one sigma of the point along that ray [m]
    seen_at: F64  # (m, 2) where, from that camera's principal point [focal lengths]
    slot: I32  # (m,) which of `keyframes` saw it
    point: I32  # (m,) which of the points below
    octave: F32  # (m,)
    angle_rad: F32  # (m,)
    pixel_m: F64  # (m,) length at the point of one raw pixel of the level that it was seen on
    ids: I32  # (n,) of the points in the map
    xyz: F64  # (n, 3) [m]
    C: F64  # (n, 6) covariance: xx xy xz yy yz zz [m^2]


class _Rows(NamedTuple):
    """Observations of one keyframe that have a point."""

    descriptors: U64
    seen_at: F64
    stretch: F64  # ideal pixels a raw pixel
    octave: F32
    angle_rad: F32
    id: I32


class PoolMaker:
    """Makes pools; remembers the keyframes that it read last. One thread owns it."""

    def __init__(self, map_: Map, capacity: int) -> None:
        self._map = map_
        self._capacity = capacity
        self._scale_factor = map_.manifest.extractor.scale_factor
        self._rows: dict[int, _Rows] = {}
        self._last: tuple[tuple[int, ...], Pool] | None = None

    def make(self, keyframes: Sequence[int]) -> Pool:
        """Pool of `keyframes`, at least one, in their order."""
        wanted = tuple(keyframes)
        if self._last is None or self._last[0] != wanted:
            self._last = wanted, self._made(wanted)
        return self._last[1]

    def _made(self, keyframes: tuple[int, ...]) -> Pool:
        rows = [self._keyframe(k) for k in keyframes]
        counts = [len(r.id) for r in rows]
        slot = np.repeat(np.arange(len(rows), dtype=np.int32), counts)
        ids, point = np.unique(_joined([r.id for r in rows]), return_inverse=True)
        points = self._map.points(ids.astype(np.int32))
        octave = _joined([r.octave for r in rows])
        T = self._map.T_map_cam[list(keyframes)]
        ray = points.xyz[point] - T[slot, :3, 3]
        depth = np.einsum("ij,ij->i", ray, T[slot, :3, 2])
        ray /= np.linalg.norm(ray, axis=1, keepdims=True)
        cameras = [self._map.cameras[self._map.keyframe_camera[k]] for k in keyframes]
        focal_px = np.array([camera.fx for camera in cameras])
        pixel_m = depth / focal_px[slot] * self._scale_factor ** octave.astype(np.float64)
        pixel_m *= _joined([r.stretch for r in rows])
        return Pool(
            np.array(keyframes, np.int32),
            _joined([r.descriptors for r in rows]),
            ray,
            _axes(points.covariance[point], ray),
            _joined([r.seen_at for r in rows]),
            slot,
            point.astype(np.int32),
            octave,
            _joined([r.angle_rad for r in rows]),
            pixel_m,
            ids.astype(np.int32),
            points.xyz,
            packed(points.covariance),
        )

    def depth_m(self, k: int) -> float:
        """Median depth of the points that keyframe `k` sees; 1 where it sees none."""
        ids = self._keyframe(k).id
        if len(ids) == 0:
            return 1.0
        T = self._map.T_map_cam[k]
        return max(float(np.median((self._map.points(ids).xyz - T[:3, 3]) @ T[:3, 2])), 1e-6)

    def _keyframe(self, k: int) -> _Rows:
        rows = self._rows.pop(k, None)
        if rows is None:
            features = self._map.features(k)
            has_point = features.point != NO_POINT
            camera = self._map.cameras[self._map.keyframe_camera[k]]
            seen_at = camera.normalise(features.pixels[has_point])
            rows = _Rows(
                np.ascontiguousarray(features.descriptors[has_point]).view(np.uint64),
                seen_at,
                magnification(camera, seen_at),
                features.octave[has_point].astype(np.float32),
                features.angle_rad[has_point],
                features.point[has_point],
            )
            if len(self._rows) >= self._capacity:
                self._rows.pop(next(iter(self._rows)))
        self._rows[k] = rows  # last in the order: it was used last
        return rows


def _axes(covariance: F64, ray: F64) -> F64:
    """Error (m, 3) that goes with one sigma along each unit ray (m, 3)."""
    moved = np.einsum("nij,nj->ni", covariance, ray)
    along = np.einsum("ni,ni->n", moved, ray)
    return np.asarray(moved / np.sqrt(np.maximum(along, 1e-30))[:, None], np.float64)


def packed(covariance: F64) -> F64:
    """Upper triangles (n, 6) xx xy xz yy yz zz of covariances (n, 3, 3)."""
    return np.ascontiguousarray(covariance[:, (0, 0, 0, 1, 1, 2), (0, 1, 2, 1, 2, 2)])


def unpacked(C: F64) -> F64:
    """Covariances (n, 3, 3) of their upper triangles (n, 6)."""
    covariance = np.empty((len(C), 3, 3))
    covariance[:, (0, 0, 0, 1, 1, 2), (0, 1, 2, 1, 2, 2)] = C
    covariance[:, (1, 2, 2), (0, 0, 1)] = C[:, (1, 2, 4)]
    return covariance


def _joined(parts: Sequence[NDArray[Any]]) -> NDArray[Any]:
    return np.concatenate(parts)
