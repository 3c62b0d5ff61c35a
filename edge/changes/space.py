# SPDX-License-Identifier: Apache-2.0
"""What the map's own images say about a place: whether they showed it, and what was there."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from edge.changes.in_view import InView
from edge.changes.seen_points import seen_points
from edge.config.changes import ChangesConfig
from edge.geometry import se3
from edge.geometry.camera import CameraModel
from edge.tiles.labels import MapLabels
from edge.tiles.reader import Map
from edge.types import F32, F64, I32, Bools, Mat4

_MARGIN_PX = 10.0
_NEIGHBOUR_PX = 10.0  # of a place, within which depths tell what hides it; a thing's half if more
_NEAREST, _FAR_PX = 5, 60.0  # depths that are asked where none is so near, and how far away
_NEARER = 0.9
_HIDING = 0.25  # of these depths: what is hidden in part may not have been found
_INSIDE = 0.7  # of the half of a thing: what is so near its middle is of it
_REACH = 0.25  # of a thing's size; so far inside a box it is in it, and so near to it of it
_ALIKE = 3.0  # sizes of boxes that may be of one thing
_OF_SPREAD, _MOST_RAD = 0.5, 0.7  # of what lies between the live views; as far beside them
_MAX_TIMES = 1.5  # the live distance: from further away the model may not find it


class Before(NamedTuple):
    """What the map's images say of a place where there is something now."""

    showing: int  # keyframes that must have shown it
    seeing: int  # in which the model saw something there, even weakly
    points: int  # of the map, where the thing now is


class _Split(NamedTuple):
    """Boxes of a keyframe."""

    free: F32  # (n, 4) of no object of the map
    owned: F32  # (m, 4) of some
    labels: I32  # (m,) of these
    fronts_m: F64  # (m,) depths of the objects' fronts


class _Outline(NamedTuple):
    """Objects of the map in a keyframe."""

    boxes: F64  # (n, 4) around their places
    depth_m: F64  # (n,)
    labels: I32  # (n,)


class KnownSpace:
    """Asks the map's keyframes. Owned by one thread."""

    def __init__(self, map_: Map, labels: MapLabels, config: ChangesConfig) -> None:
        self._map, self._labels, self._config = map_, labels, config
        self._boxes: dict[int, _Split] = {}  # of each keyframe that was asked
        self._outlines: dict[int, _Outline] = {}  # too
        self._in_view: dict[int, InView] = {}  # of each camera

    def views(
        self,
        center: F64,
        radius_m: float,
        cameras: F64,
        label: int,
        like_deg: float,
        *,
        hides: bool,
    ) -> Before:
        """What keyframes that must have shown a thing there say of it.

        `cameras` (n, 3) are the places that it is seen from now: only views less than `like_deg`
        beside those count, or more where these spread. `label` is its class. Where it `hides` what
        the map saw through its place, nothing else stood before it.
        """
        away = cameras - center
        reach = _MAX_TIMES * float(np.linalg.norm(away, axis=1).max())
        directions = away / np.linalg.norm(away, axis=1, keepdims=True)
        showing = seeing = 0
        inside: set[int] = set()
        # What the model finds from many sides, it would have found from beside these, too.
        spread = float(np.arccos(np.clip((directions @ directions.T).min(), -1.0, 1.0)))
        like = float(np.cos(max(np.radians(like_deg), min(_OF_SPREAD * spread, _MOST_RAD))))
        for k, is_aside in self._candidates(center, reach, directions, like):
            pixel = self._shown(k, center, radius_m, may_hide=is_aside and not hides)
            if pixel is None:
                continue
            if self._is_of_another(k, pixel, center, radius_m, label):
                seeing += self._was_left_over(k, pixel, center, radius_m, label)
                continue
            showing += 1
            seeing += self._saw(k, pixel, center, radius_m)
            inside |= self._inside(k, center, radius_m)
        return Before(showing, seeing, len(inside))

    def _inside(self, k: int, center: F64, radius_m: float) -> set[int]:
        """Points that a keyframe sees within the thing, and surely so: not of what it stands on."""
        points = seen_points(self._map, k)[0].point
        found = self._map.points(points)
        sigma_m = np.sqrt(np.einsum("nii->n", found.covariance))
        near = np.linalg.norm(found.xyz - center, axis=1) + sigma_m < _INSIDE * radius_m
        return set(points[near].tolist())

    def _candidates(
        self, center: F64, reach: float, directions: F64, like: float
    ) -> Iterator[tuple[int, bool]]:
        """Keyframes from like directions, and whether these are not quite those of now."""
        away = self._map.T_map_cam[:, :3, 3] - center
        distance = np.linalg.norm(away, axis=1)
        cosine = (away / np.maximum(distance, 1e-9)[:, None]) @ directions.T
        nearest = cosine.max(axis=1)
        near = self._labels.looked_at & (distance < reach) & (nearest > like)
        aside = nearest < np.cos(np.radians(self._config.free_view_deg))
        for k in np.flatnonzero(near).tolist():
            yield k, bool(aside[k])

    def _shown(self, k: int, center: F64, radius_m: float, *, may_hide: bool) -> F64 | None:
        """Pixel (2,) of a place in a keyframe that shows it; None where it does not.

        Where something that the map knows nothing of `may_hide` it, depths right there must tell.
        """
        camera: CameraModel = self._map.cameras[int(self._map.keyframe_camera[k])]
        T_cam_map = se3.inverse(self._map.pose(k))
        local = se3.transform(T_cam_map, center[None])
        pixel: F64 = camera.project(local)[0]
        limit = np.array([camera.width, camera.height]) - 1.0 - _MARGIN_PX
        size = self._size(k, center, radius_m)
        inside = ((pixel >= _MARGIN_PX) & (pixel <= limit)).all()
        if not inside or size**2 < self._config.presence.min_size_px:
            return None
        ideal = np.array([camera.fx, camera.fy]) * local[0, :2] / local[0, 2]
        ideal += (camera.cx, camera.cy)
        reach = max(radius_m / local[0, 2] * float(camera.fx), _NEIGHBOUR_PX)
        # From other directions than now, other things may stand before it.
        nearest = 0 if may_hide else _NEAREST
        depth = self._depths_about(k, ideal, T_cam_map, reach, nearest)
        # Where nothing is known, a plain surface may hide the place.
        hiding = (depth < _NEARER * local[0, 2]).mean() if len(depth) else 1.0
        if hiding > _HIDING or self._is_behind_a_thing(k, pixel, local[0, 2], size):
            return None
        return pixel

    def _depths_about(
        self, k: int, pixel: F64, T_cam_map: Mat4, reach_px: float, nearest: int
    ) -> F64:
        """Depths (n,) that a keyframe knows around a pixel; so many of the nearest if none."""
        (features, xyz), samples = seen_points(self._map, k), self._map.depth_samples(k)
        apart = np.linalg.norm(np.concatenate([features.pixels, samples.pixels]) - pixel, axis=1)
        given = 1.0 / samples.inverse_depth.astype(np.float64)
        depth = np.concatenate([se3.transform(T_cam_map, xyz)[:, 2], given])
        if (near := apart < reach_px).any():
            known: F64 = depth[near]
            return known
        order = np.argsort(apart, kind="stable")[:nearest]
        around: F64 = depth[order[apart[order] < _FAR_PX]]
        return around

    def _is_behind_a_thing(self, k: int, pixel: F64, depth_m: float, size_px: float) -> bool:
        """Whether an object of the map stands before a place.

        A much larger one may be what is below; where it stands before, depths tell.
        """
        outline = self._outline(k)
        over = _hold(outline.boxes, pixel) & (_sides(outline.boxes) < _ALIKE * size_px)
        return bool((over & (outline.depth_m < _NEARER * depth_m)).any())

    def _outline(self, k: int) -> _Outline:
        """The objects of the map before a keyframe."""
        if k not in self._outlines:
            self._outlines[k] = self._outlined(k)
        return self._outlines[k]

    def _outlined(self, k: int) -> _Outline:
        number = int(self._map.keyframe_camera[k])
        if number not in self._in_view:
            self._in_view[number] = InView(self._labels.objects, self._map.cameras[number])
        T_cam_map = se3.inverse(self._map.pose(k))
        boxes, depths, labels = [], [], []
        for i in self._in_view[number].of(self._map.pose(k)):
            local = se3.transform(T_cam_map, self._labels.objects[i].points)
            outline = self._map.cameras[number].project(local)
            if local[:, 2].mean() > 0.0 and np.isfinite(outline).all():
                boxes.append((*outline.min(axis=0), *outline.max(axis=0)))
                depths.append(local[:, 2].mean())
                labels.append(self._labels.objects[i].label)
        return _Outline(
            np.array(boxes).reshape(-1, 4), np.array(depths), np.array(labels, np.int32)
        )

    def _saw(self, k: int, pixel: F64, center: F64, radius_m: float) -> bool:
        boxes = self._split(k).free
        size = self._size(k, center, radius_m)
        slack = _REACH * size
        inside: Bools = _hold(boxes, pixel, slack)
        sides = _sides(boxes)
        alike = (sides > size / _ALIKE) & (sides < size * _ALIKE)
        return bool((inside & alike).any())

    def _is_of_another(self, k: int, pixel: F64, center: F64, radius_m: float, label: int) -> bool:
        """Whether a mask of an object of the map, not far behind, lay over a place.

        It may have held two alike things, or have hidden one; but what a thing stands on is
        larger and hides nothing.
        """
        split = self._split(k)
        boxes = split.owned
        over = _hold(boxes, pixel)
        over &= (split.labels == label) | (_sides(boxes) < _ALIKE * self._size(k, center, radius_m))
        own = float(se3.transform(se3.inverse(self._map.pose(k)), center[None])[0, 2])
        not_behind = (split.fronts_m < own + radius_m) | (split.labels == label)
        return bool((over & not_behind).any())

    def _was_left_over(self, k: int, pixel: F64, center: F64, radius_m: float, label: int) -> bool:
        """Whether a mask of its kind held a place that no object of the map takes: one of two.

        What stood beside another in nearly all images is under one mask with that, and is not in
        the space that all of its masks hold.
        """
        reach = _REACH * self._size(k, center, radius_m)
        split, outline = self._split(k), self._outline(k)
        held = _hold(split.owned[split.labels == label], pixel, -reach).any()
        taken = _hold(outline.boxes[outline.labels == label], pixel, reach).any()
        return bool(held) and not bool(taken)

    def _size(self, k: int, center: F64, radius_m: float) -> float:
        """How many pixels a thing spans in a keyframe."""
        camera = self._map.cameras[int(self._map.keyframe_camera[k])]
        distance = float(np.linalg.norm(center - self._map.pose(k)[:3, 3]))
        return 2.0 * radius_m / distance * float(np.sqrt(camera.fx * camera.fy))

    def _split(self, k: int) -> _Split:
        if k not in self._boxes:
            camera = self._map.cameras[int(self._map.keyframe_camera[k])]
            boxes, labels, _ = self._labels.detections(k)
            centers = np.array([thing.center for thing in self._labels.objects]).reshape(-1, 3)
            halves = np.array([0.5 * thing.extent_m.max() for thing in self._labels.objects])
            local = se3.transform(se3.inverse(self._map.pose(k)), centers)
            at = camera.project(local)
            middle = 0.5 * (boxes[:, None, :2] + boxes[:, None, 2:])
            half = 0.5 * (boxes[:, None, 2:] - boxes[:, None, :2])
            close = np.asarray((np.abs(at[None] - middle) < 0.5 * half + 2.0).all(axis=2))
            owned = close.any(axis=1)
            fronts = np.where(close, (local[:, 2] - halves)[None], np.inf)
            front = fronts.min(axis=1, initial=np.inf)
            self._boxes[k] = _Split(boxes[~owned], boxes[owned], labels[owned], front[owned])
        return self._boxes[k]


def _hold(boxes: F32 | F64, pixel: F64, slack: float = 0.0) -> Bools:
    """Which boxes (n, 4) hold a pixel (2,), or come so near to it [px]."""
    after, before = boxes[:, :2] - slack <= pixel, pixel <= boxes[:, 2:] + slack
    return np.asarray(np.all(after, axis=1) & np.all(before, axis=1))


def _sides(boxes: F32 | F64) -> F64:
    """Side (n,) of the square that is as large as each box [px]."""
    sides: F64 = np.sqrt(np.prod(np.maximum(boxes[:, 2:] - boxes[:, :2], 1.0), axis=1))
    return sides
