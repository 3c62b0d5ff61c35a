# SPDX-License-Identifier: Apache-2.0
"""Which points of the map an image shows at their place, and which it contradicts.

A point's descriptor is compared with what the image holds where the point must be, not with the
corners that a detector happens to find: so not finding it means that something else is there.
"""

from collections import OrderedDict
from collections.abc import Callable
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from edge.changes.cover import between, holds
from edge.changes.seen_points import seen_points
from edge.config.changes import ProofConfig
from edge.geometry import se3
from edge.geometry.camera import CameraModel
from edge.tiles.reader import KeyframeFeatures, Map
from edge.types import F32, F64, I32, U8, Bools, Mask, Mat4

CONFIRMED, OPEN, CONTRADICTED = 1, 0, -1
_PATCH_PX = 31  # side of a descriptor's patch at its own level
_MOST = 0.6  # of a patch: the rest may be beside the mask
_OWN = 0.4  # of the patch of a point that a thing bears: else it shows what is beside it
_EDGE_PX = 1  # masks are wrong by so much
_AT = 0.93  # of its depth: what is nearer is not hidden
# Places in a patch, in halves of its side.
_RINGS = np.array(
    [(r * np.cos(a), r * np.sin(a)) for r in (0.45, 0.9) for a in np.arange(8) * (np.pi / 4.0)]
)
_KEPT = 32  # keyframes
_BITS = np.array([bin(i).count("1") for i in range(256)], np.uint8)


class Proof(NamedTuple):
    """What an image says about points that it should show."""

    points: I32  # (n,) of the map, each once
    xyz: F64  # (n, 3) [m]
    pixels: F32  # (n, 2) where they must be, in the camera's own image
    depth_m: F64  # (n,) along the camera's axis
    patch_px: F64  # (n,) half of the side of the patch that was compared
    verdict: I32  # (n,) CONFIRMED, OPEN or CONTRADICTED

    def behind(self, mask: Mask, depth_m: float) -> I32:
        """Rows (m,) of the points that a mask's thing at that depth (NaN: unknown) would hide.

        Those of which it hides hardly more than the middle do not count.
        """
        nearer = self.depth_m < _AT * depth_m
        near = np.flatnonzero(holds(mask, self.pixels) & ~nearer)
        rows: I32 = near[self._held(mask, near) >= _MOST].astype(np.int32)
        return rows

    def at(self, mask: Mask, depth_m: float, within_m: float) -> I32:
        """Rows (m,) of the points well inside a mask that lie at a depth, not before or behind."""
        kernel = np.ones((2 * _EDGE_PX + 1, 2 * _EDGE_PX + 1), np.uint8)
        inner = cv2.erode(np.pad(mask.inside.astype(np.uint8), 1), kernel)[1:-1, 1:-1] > 0
        there = np.abs(self.depth_m - depth_m) < within_m
        rows = np.flatnonzero(holds(mask._replace(inside=inner), self.pixels) & there)
        own: I32 = rows[self._held(mask, rows) >= _OWN].astype(np.int32)
        return own

    def on(self, points: I32, mask: Mask) -> I32:
        """Rows (m,) of those of these points whose patches show the mask, not what is beside it."""
        rows = np.flatnonzero(np.isin(self.points, points))
        own: I32 = rows[self._held(mask, rows) >= _OWN].astype(np.int32)
        return own

    def _held(self, mask: Mask, rows: NDArray[np.int64]) -> F64:
        """Share (m,) of the patch of each of these points that a mask holds."""
        around = self.pixels[rows, None] + self.patch_px[rows, None, None] * _RINGS
        held: F64 = holds(mask, around.reshape(-1, 2)).reshape(len(rows), len(_RINGS)).mean(axis=1)
        return held


class _Views(NamedTuple):
    """Points as keyframes saw them, predicted for an image."""

    points: I32
    xyz: F64
    pixels: F32
    depth_m: F64
    octave: I32
    angle_deg: F64
    descriptors: U8


class Prover:
    """Compares images with the map's points. Owned by one thread."""

    def __init__(self, map_: Map, camera: CameraModel, config: ProofConfig) -> None:
        self._map, self._camera, self._config = map_, camera, config
        extractor = map_.manifest.extractor
        # Those of the last keyframes: the next image is near the same ones.
        self._features: OrderedDict[int, tuple[KeyframeFeatures, F64]] = OrderedDict()
        self._scale, self._levels = extractor.scale_factor, extractor.levels
        self._orb = cv2.ORB.create(
            nfeatures=1 << 16,
            scaleFactor=self._scale,
            nlevels=self._levels,
            edgeThreshold=0,
            patchSize=_PATCH_PX,
        )

    def prove(
        self,
        image: U8,
        T_map_cam: Mat4,
        preferred: Callable[[I32, F32], Bools] | None = None,
        *,
        alone: bool = False,
    ) -> Proof:
        """What the grey image (h, w) taken at this pose says about the points around.

        `preferred` tells of points and their pixels which to ask for before all others, or
        which `alone` to ask for.
        """
        views = self._predict(T_map_cam)
        if preferred is not None and alone:
            views = _rows(views, np.flatnonzero(preferred(views.points, views.pixels)))
        if len(views.points) > self._config.max_points:
            order = np.arange(len(views.points)) * 7919 % 8191  # of each place some
            if preferred is not None and not alone:
                order = np.where(preferred(views.points, views.pixels), -1, order)
            kept = np.sort(np.argsort(order, kind="stable")[: self._config.max_points])
            views = _rows(views, kept)
        if len(views.points) == 0:
            return Proof(*views[:4], np.empty(0), views.points)
        bits = self._compare(image, views)
        verdict: I32 = np.zeros(len(bits), np.int32)
        verdict[bits <= self._config.same_bits] = CONFIRMED
        verdict[bits > self._config.other_bits] = CONTRADICTED
        patch: F64 = 0.5 * _PATCH_PX * self._scale ** views.octave.astype(np.float64)
        return Proof(*views[:4], patch, verdict)

    def _predict(self, T_map_cam: Mat4) -> _Views:
        """Points that keyframes saw from near here; of several views of a point the most alike."""
        parts = [self._predict_from(int(k), T_map_cam) for k in self._near(T_map_cam)]
        parts = [part for part in parts if len(part.points)]
        if not parts:
            return _no_views()
        columns: list[Any] = [np.concatenate(arrays) for arrays in zip(*parts, strict=True)]
        _, first = np.unique(columns[0], return_index=True)  # keyframes come most alike first
        return _Views(*(column[first] for column in columns))

    def _near(self, T_map_cam: Mat4) -> I32:
        """Keyframes that look the same way from near here, the nearest first."""
        poses = self._map.T_map_cam
        config = self._config
        apart = np.linalg.norm(poses[:, :3, 3] - T_map_cam[:3, 3], axis=1)
        turned = np.degrees(np.arccos(np.clip(poses[:, :3, 2] @ T_map_cam[:3, 2], -1.0, 1.0)))
        cost = apart / config.near_m + turned / config.near_deg
        order = np.argsort(cost, kind="stable")[: config.keyframes]
        near: I32 = order[cost[order] < 2.0].astype(np.int32)
        return near

    def _predict_from(self, k: int, T_map_cam: Mat4) -> _Views:
        features, xyz = self._read(k)
        T_map_kf, config = self._map.pose(k), self._config
        local = se3.transform(se3.inverse(T_map_cam), xyz)
        pixels = self._camera.project(local)
        limit = np.array([self._camera.width, self._camera.height]) - 1.0
        rows = np.flatnonzero(between(pixels, (0.0, 0.0), limit))  # NaN behind the camera
        xyz, pixels = xyz[rows], pixels[rows]
        there, here = xyz - T_map_kf[:3, 3], xyz - T_map_cam[:3, 3]
        far, near = np.linalg.norm(there, axis=1), np.linalg.norm(here, axis=1)
        cosine = np.einsum("ni,ni->n", there, here) / np.maximum(far * near, 1e-12)
        old = features.octave[rows]
        octave = old + np.log(far / np.maximum(near, 1e-9)) / np.log(self._scale)
        octave = np.rint(octave).astype(np.int32)
        border = config.border_px * self._scale ** np.clip(octave, 0, self._levels)
        kept = cosine > np.cos(np.radians(config.angle_deg))
        kept &= between(pixels, (border, border), limit[:, None] - border)
        # A descriptor bears two levels of blur, not three.
        kept &= (octave >= -1) & (octave < self._levels)
        kept &= np.abs(octave - old) <= config.octaves
        rows = rows[kept]
        turn = T_map_cam[:3, :3].T @ T_map_kf[:3, :3]
        x, y = np.cos(features.angle_rad[rows]), np.sin(features.angle_rad[rows])
        axis = turn[:2, 0][:, None] * x + turn[:2, 1][:, None] * y
        return _Views(
            features.point[rows],
            xyz[kept],
            pixels[kept].astype(np.float32),
            local[rows, 2],
            np.maximum(octave[kept], 0),
            np.degrees(np.arctan2(axis[1], axis[0])) % 360.0,
            features.descriptors[rows],
        )

    def _read(self, k: int) -> tuple[KeyframeFeatures, F64]:
        """The features of a keyframe and the places (n, 3) of their points."""
        if k not in self._features:
            if len(self._features) >= _KEPT:
                self._features.popitem(last=False)
            self._features[k] = seen_points(self._map, k)
        self._features.move_to_end(k)
        return self._features[k]

    def _compare(self, image: U8, views: _Views) -> I32:
        """Distance (n,) [bits] of the descriptors around each predicted place, about the least.

        Most points are right where they must be; only the others are searched for.
        """
        bits = self._distances(image, views, np.arange(len(views.points)), np.zeros((1, 2)))
        reach = self._config.search_steps
        steps = np.arange(-reach, reach + 1) * self._config.step_px
        grid = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
        missed = np.flatnonzero(bits > self._config.same_bits)
        bits[missed] = self._distances(image, views, missed, grid)[missed]
        return bits

    def _distances(self, image: U8, views: _Views, rows: NDArray[np.int64], offsets: F64) -> I32:
        """Least distance (n,) [bits] over places `offsets` (m, 2) beside the predicted; of `rows`.

        256 elsewhere, and where nothing can be described.
        """
        keypoints = []
        for i in rows.tolist():
            (u, v), octave = views.pixels[i].tolist(), int(views.octave[i])
            size, angle = _PATCH_PX * self._scale**octave, float(views.angle_deg[i])
            keypoints += [
                cv2.KeyPoint(u + dx, v + dy, size, angle, 0.0, octave, i)
                for dx, dy in (offsets * self._scale ** (0.5 * octave)).tolist()
            ]
        least: I32 = np.full(len(views.points), 256, np.int32)
        if not keypoints:
            return least
        described, descriptors = self._orb.compute(image, keypoints)
        if described:
            owner = np.array([keypoint.class_id for keypoint in described])
            off = _BITS[descriptors ^ views.descriptors[owner]].sum(axis=1, dtype=np.int32)
            np.minimum.at(least, owner, off)
        return least


def _rows(views: _Views, kept: NDArray[np.intp]) -> _Views:
    columns: list[Any] = [column[kept] for column in views]
    return _Views(*columns)


def _no_views() -> _Views:
    none = np.empty(0, np.int32)
    return _Views(
        none, np.empty((0, 3)), np.empty((0, 2), np.float32), np.empty(0), none, np.empty(0),
        np.empty((0, 32), np.uint8),
    )  # fmt: skip
