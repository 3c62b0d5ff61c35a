# SPDX-License-Identifier: Apache-2.0
"""What moves by itself in an image, and what the odometry must not measure by it.

Masks come late, and of a frame now and then. A keyframe is cleared by the first that are of its
time or later: its points and candidates under them are dropped. While something moves, candidates
wait for that before they are used.
"""

from collections.abc import Callable

import cv2
import numpy as np

from edge.geometry import se3
from edge.geometry.camera import CameraModel
from edge.odometry import kernels_trace as ktr
from edge.odometry import kernels_window as kw
from edge.odometry.keyframe import Keyframe
from edge.odometry.window import Window
from edge.types import F32, F64, U8, Bools, Mat4, Moving, Pinhole

_GROWN_SHARE = 0.02  # of an image's width: masks end early, and what moves goes on
_BEFORE_NS = 50_000_000  # masks of so much before a keyframe are still of it
_LASTS_NS = 1_500_000_000  # after it was seen, something may still move in view
_PATIENCE_NS = 1_000_000_000  # the model may have ended
_KEPT_POSES = 64
_LEAST_POINTS = 60  # with fewer the odometry is lost anyway; a mask over all is more likely wrong


class Covered:
    """Where something moved in one frame, whose pose the odometry knows."""

    def __init__(self, moving: Moving, T_cam_odom: Mat4, camera: CameraModel) -> None:
        self.t_ns = moving.t_ns
        self.is_empty = not moving.masks
        self.T_cam_odom = T_cam_odom
        self._camera = camera
        reach = max(round(_GROWN_SHARE * camera.width), 1)
        inside: U8 = np.zeros((camera.height, camera.width), np.uint8)
        for mask in moving.masks:
            h, w = mask.inside.shape
            part = inside[mask.top : mask.top + h, mask.left : mask.left + w]
            part |= mask.inside.astype(np.uint8)
        self._inside = cv2.dilate(inside, np.ones((2 * reach + 1, 2 * reach + 1), np.uint8))

    def holds(self, points: F64) -> Bools:
        """Which points (n, 3) of the odometry's frame lie under a mask."""
        local = se3.transform(self.T_cam_odom, points)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            pixels = self._camera.project(local)
        h, w = self._inside.shape
        place = np.rint(np.nan_to_num(pixels, nan=-1.0, posinf=-1.0, neginf=-1.0))
        held: Bools = (local[:, 2] > 0.0) & (place >= 0).all(axis=1)
        held &= (place[:, 0] < w) & (place[:, 1] < h)
        column, row = place[held].astype(np.int64).T
        held[held] = self._inside[row, column] > 0
        return held


class RecentPoses:
    """Poses of the last frames: masks come late. Owned by the tracking thread."""

    def __init__(self, camera: CameraModel) -> None:
        self._camera = camera
        self._T_odom_cam: dict[int, Mat4] = {}  # by the frames' indices

    def add(self, index: int, T_odom_cam: Mat4) -> None:
        """Remember where a frame was taken."""
        self._T_odom_cam[index] = T_odom_cam
        if len(self._T_odom_cam) > _KEPT_POSES:
            del self._T_odom_cam[next(iter(self._T_odom_cam))]

    def of(self, index: int) -> Mat4 | None:
        """T_odom_cam of a recent frame."""
        return self._T_odom_cam.get(index)

    def clear(self) -> None:
        """Forget all: another odometry frame begins."""
        self._T_odom_cam.clear()

    def cover(self, moving: Moving) -> Callable[[], Covered] | None:
        """What makes out what moved, where its frame was taken; None if that is not known any more.

        That takes milliseconds, so whoever needs it has it made.
        """
        T_odom_cam, camera = self._T_odom_cam.get(moving.index), self._camera
        if T_odom_cam is None:
            return None
        return lambda: Covered(moving, se3.inverse(T_odom_cam), camera)


def clear(window: Window, xyz: F32, covered: Covered, pinhole: Pinhole) -> None:
    """Clear keyframes: take points, at `xyz` (n, 3), and candidates under masks out of them."""
    stamps_ns = [keyframe.frame.t_ns for keyframe in window.keyframes]
    onward = 1 if stamps_ns[-1] >= stamps_ns[0] else -1  # a recording may be played in reverse
    fresh = [
        k
        for k, keyframe in enumerate(window.keyframes)
        if not keyframe.is_clear and onward * (stamps_ns[k] - covered.t_ns) <= _BEFORE_NS
    ]
    usual = _usual_inverse_depth(window)
    for k in fresh:
        keyframe = window.keyframes[k]
        keyframe.is_clear, keyframe.waits = True, False
        if not covered.is_empty:
            keyframe.candidates = _spared(keyframe.candidates, keyframe, covered, pinhole, usual)
    if fresh and not covered.is_empty:
        held = np.isin(window.host, fresh)
        held[held] = covered.holds(xyz[held].astype(np.float64))
        if (~held).sum() >= _LEAST_POINTS:
            window.keep_points(~held)


def let_wait(window: Window, covered: Covered | None) -> None:
    """Let the newest keyframe's candidates wait while things move; others not for too long."""
    newest = window.keyframes[-1]
    now_ns = newest.frame.t_ns
    moves = covered is not None and not covered.is_empty
    newest.waits = moves and covered is not None and abs(now_ns - covered.t_ns) < _LASTS_NS
    for keyframe in window.keyframes[:-1]:
        keyframe.waits &= abs(now_ns - keyframe.frame.t_ns) < _PATIENCE_NS


def _spared(
    table: F32, keyframe: Keyframe, covered: Covered, pinhole: Pinhole, usual: float
) -> F32:
    """The candidates (30, n) of a keyframe without those that lie under the masks.

    Where their depth is not known, they count as `usual` far [1 / odometry unit].
    """
    if table.shape[1] == 0:
        return table
    known = np.isfinite(table[ktr.HIGH])
    middle = 0.5 * (table[ktr.LOW] + np.where(known, table[ktr.HIGH], 0.0))
    inverse = np.where(known & (middle > 0.0), middle, usual).astype(np.float64)
    u, v = table[[kw.U, kw.V]].astype(np.float64)
    rays = np.column_stack(
        ((u - pinhole.cx) / pinhole.fx, (v - pinhole.cy) / pinhole.fy, np.ones(len(u)))
    )
    held = covered.holds(se3.transform(keyframe.T_odom_cam, rays / inverse[:, None]))
    return np.ascontiguousarray(table[:, ~held])


def _usual_inverse_depth(window: Window) -> float:
    """Median inverse depth of the active points [1 / odometry unit]."""
    inverse = window.points[kw.IDEPTH]
    positive = inverse[inverse > 0.0]
    return float(np.median(positive)) if len(positive) else 1.0
