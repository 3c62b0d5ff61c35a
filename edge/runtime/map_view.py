# SPDX-License-Identifier: Apache-2.0
"""What a map knows of the view from a place, drawn: its points by their distance, its objects."""

import cv2
import numpy as np

from edge.changes.portrait import corners, nearest_portrait
from edge.geometry import se3
from edge.geometry.camera import CameraModel
from edge.runtime.drawing import outline, write
from edge.tiles.labels import read_labels
from edge.tiles.reader import Map
from edge.tiles.tile import PORTRAIT_CELLS
from edge.types import F64, I32, U8, Mat4

_KEYFRAMES = 16  # whose points are shown
_NEAR_M, _NEAR_DEG = 1.0, 30.0  # what counts as near them
_DOT_SHARE = 0.0025  # of the image's height
_FADED = 0.3  # of the present image's brightness, under the points
_OBJECT = (230, 230, 230)
_RING, _RING_PX, _FAR_PX = (255, 255, 255), 4, 10_000
_NEAREST_M = 0.05
_MAX_OBJECTS = 40


class MapView:
    """Draws views of one map. Owned by one thread."""

    def __init__(self, map_: Map, camera: CameraModel) -> None:
        self._map, self._camera = map_, camera
        self._labels = read_labels(map_)

    def draw(self, T_map_cam: Mat4, present: U8, box: tuple[F64, F64]) -> U8:
        """The map as the camera would see it (h, w, 3), over a faded present image (h, w).

        Points in the `box`, of a middle (3,) and sides (3,), have a ring; objects in it look as
        they did when the map was made.
        """
        faded = (_FADED * present).astype(np.uint8)
        picture: U8 = cv2.cvtColor(faded, cv2.COLOR_GRAY2BGR)
        points = self._around(T_map_cam)
        if len(points):
            xyz = self._map.points(points).xyz
            self._draw_points(picture, T_map_cam, xyz)
        self._draw_portraits(picture, T_map_cam, box)
        if len(points):
            inside = (np.abs(xyz - box[0]) <= 0.5 * box[1] + 1e-6).all(axis=1)
            self._draw_rings(picture, T_map_cam, xyz[inside])
        self._draw_objects(picture, T_map_cam)
        return picture

    def _around(self, T_map_cam: Mat4) -> I32:
        """Points that keyframes see that look the same way from near here."""
        poses = self._map.T_map_cam
        apart = np.linalg.norm(poses[:, :3, 3] - T_map_cam[:3, 3], axis=1)
        turned = np.degrees(np.arccos(np.clip(poses[:, :3, 2] @ T_map_cam[:3, 2], -1.0, 1.0)))
        nearest = np.argsort(apart / _NEAR_M + turned / _NEAR_DEG, kind="stable")[:_KEYFRAMES]
        seen = [self._map.features(int(k)).point for k in nearest]
        points: I32 = np.unique(np.concatenate([np.empty(0, np.int32), *seen]))
        return points[points >= 0]

    def _draw_points(self, picture: U8, T_map_cam: Mat4, xyz: F64) -> None:
        """The near ones bright and large, over the far ones."""
        local = se3.transform(se3.inverse(T_map_cam), xyz)
        pixels = self._camera.project(local)
        h, w = picture.shape[:2]
        with np.errstate(invalid="ignore"):
            inside = (local[:, 2] > _NEAREST_M) & ((pixels >= 0) & (pixels < (w, h))).all(axis=1)
        pixels, depth = pixels[inside], local[inside, 2]
        if len(depth) == 0:
            return
        near, far = np.percentile(depth, (5.0, 95.0))
        share = np.clip((depth - near) / max(float(far - near), 1e-6), 0.0, 1.0)
        hue = (255.0 * (1.0 - share)).astype(np.uint8)[:, None]
        colours = cv2.applyColorMap(hue, cv2.COLORMAP_TURBO)[:, 0].tolist()
        dot = max(1.0, _DOT_SHARE * h)
        radii = np.rint(dot * (1.0 + 1.2 * (1.0 - share))).astype(int).tolist()
        places = np.rint(pixels).astype(int).tolist()
        for i in np.argsort(-depth, kind="stable").tolist():
            cv2.circle(picture, places[i], radii[i], colours[i], -1, cv2.LINE_AA)

    def _draw_portraits(self, picture: U8, T_map_cam: Mat4, box: tuple[F64, F64]) -> None:
        for thing in [] if self._labels is None else self._labels.objects:
            portrait = nearest_portrait(thing, T_map_cam[:3, 3])
            if portrait is None or (np.abs(thing.center - box[0]) > 0.5 * box[1] + 1e-6).any():
                continue
            local = se3.transform(se3.inverse(T_map_cam), corners(thing, portrait))
            pixels = self._camera.project(local).astype(np.float32)
            if not (np.isfinite(pixels).all() and np.abs(pixels).max() < _FAR_PX):
                continue
            side = PORTRAIT_CELLS - 1.0
            square = np.array([[0, 0], [side, 0], [side, side], [0, side]], np.float32)
            onto, size = cv2.getPerspectiveTransform(square, pixels), picture.shape[1::-1]
            seen = cv2.warpPerspective(portrait.grey, onto, size)
            inside = cv2.warpPerspective(np.ones_like(portrait.grey), onto, size)
            picture[inside > 0] = seen[inside > 0, None]

    def _draw_rings(self, picture: U8, T_map_cam: Mat4, xyz: F64) -> None:
        local = se3.transform(se3.inverse(T_map_cam), xyz)
        for pixel in self._camera.project(local[local[:, 2] > _NEAREST_M]):
            if np.isfinite(pixel).all() and np.abs(pixel).max() < _FAR_PX:
                place = (round(pixel[0]), round(pixel[1]))
                cv2.circle(picture, place, _RING_PX, _RING, 1, cv2.LINE_AA)

    def _draw_objects(self, picture: U8, T_map_cam: Mat4) -> None:
        """Outlines and names of the map's objects."""
        if self._labels is None:
            return
        T_cam_map, (h, w) = se3.inverse(T_map_cam), picture.shape[:2]
        shown = 0
        for thing in self._labels.objects:
            local = se3.transform(T_cam_map, thing.points)
            pixels = self._camera.project(local)
            middle = np.median(pixels, axis=0)
            if local[:, 2].min() < _NEAREST_M or not ((middle >= 0) & (middle < (w, h))).all():
                continue
            outline(picture, pixels, _OBJECT, 1)
            top = pixels[np.argmin(pixels[:, 1])]
            write(picture, self._labels.names[thing.label], top, _OBJECT)
            shown += 1
            if shown == _MAX_OBJECTS:
                return
