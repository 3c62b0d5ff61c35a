# SPDX-License-Identifier: Apache-2.0
"""Which images changes are looked for in, and what the odometry knows of the scene there."""

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from edge.config import Config
from edge.geometry import sim3
from edge.geometry.camera import CameraModel
from edge.geometry.covariance import position_sigma
from edge.outputs.point_cloud import map_from_odometry
from edge.outputs.report import FrameReport
from edge.types import (
    F64,
    U8,
    DepthSamples,
    Frame,
    KeyframeResult,
    MapPose,
    Mat4,
    OdometryUpdate,
)

UNPLACED = 12  # frames that were looked at before their poses were known: the last seconds

_KEPT_KEYFRAMES = 5
_SURE_DEPTH = 0.1  # relative deviation


class Sight(NamedTuple):
    """A frame to look at, and where it was taken."""

    frame: Frame
    T_map_cam: Mat4 | None  # None where that is not known: what moves is seen all the same
    surface: Callable[[], F64]  # makes (n, 3) in the map [m]: whoever looks has the time for it
    depth: DepthSamples | None = None  # of this very frame, in the map's unit
    # T_map_cam of frames that were looked at without a pose and have one now, by their index.
    placed: Mapping[int, Mat4] = MappingProxyType({})


class Chooser:
    """Which frames are looked at, with the surfaces that the odometry measured lately.

    A model gets frames as they come. Without one, depths count as much as the image: keyframes.
    """

    def __init__(self, config: Config, camera: CameraModel) -> None:
        self._changes, self._camera = config.changes, camera
        self._has_model = bool(config.segmenter.model)
        self._sees_moving = self._has_model and bool(config.segmenter.moving)
        self._keyframes: deque[KeyframeResult] = deque(maxlen=_KEPT_KEYFRAMES)
        self._odom_id = 0
        self._last_ns: int | None = None
        self._unplaced: deque[int] = deque(maxlen=UNPLACED)  # frames that were looked at so
        self._T_odom_cam: dict[int, Mat4] = {}  # of those, where the odometry knows

    def choose(self, frame: Frame, report: FrameReport) -> Sight | None:
        """The frame, if its pose is sure and its turn has come."""
        update, pose = report.update, report.pose
        if update.odom_id != self._odom_id:
            self._odom_id = update.odom_id
            self._keyframes.clear()
            self._T_odom_cam.clear()
        if update.keyframe is not None:
            self._keyframes.append(update.keyframe)
            self._look_back(update.keyframe)
        sight = self._sight(frame, update, pose) if self._is_due(frame.t_ns) else None
        if sight is not None:
            self._last_ns = frame.t_ns
            if sight.T_map_cam is None:
                self._wait_for_place(frame.index, update.T_odom_cam)
        return sight

    def _wait_for_place(self, index: int, T_odom_cam: Mat4 | None) -> None:
        """Remember a frame without a pose, and where the odometry has it."""
        if len(self._unplaced) == UNPLACED:
            self._T_odom_cam.pop(self._unplaced[0], None)
        self._unplaced.append(index)
        if T_odom_cam is not None:
            self._T_odom_cam[index] = T_odom_cam

    def _look_back(self, keyframe: KeyframeResult) -> None:
        """Take where frames were of which the odometry knows that only now."""
        for pose in keyframe.followed:
            if pose.index in self._unplaced:
                self._T_odom_cam[pose.index] = pose.T_odom_cam

    def _sight(self, frame: Frame, update: OdometryUpdate, pose: MapPose | None) -> Sight | None:
        if pose is None or not position_sigma(pose.covariance) < self._changes.pose_sigma_m:
            return Sight(frame, None, _no_surface) if self._sees_moving else None
        return self._frame(frame, update, pose) if self._has_model else self._keyframe(update, pose)

    def _frame(self, frame: Frame, update: OdometryUpdate, pose: MapPose) -> Sight:
        if update.T_odom_cam is None:
            return Sight(frame, pose.T_map_cam, _no_surface)
        S_map_odom = map_from_odometry(pose, update.T_odom_cam)
        # With each frame anew: whoever looks may never have come to the one before.
        placed = {
            index: sim3.transform_pose(S_map_odom, self._T_odom_cam[index])
            for index in self._unplaced
            if index in self._T_odom_cam
        }
        return Sight(frame, pose.T_map_cam, self._surface(S_map_odom), placed=placed)

    def _keyframe(self, update: OdometryUpdate, pose: MapPose) -> Sight | None:
        """The keyframe that has just been worked on; None if none has."""
        keyframe = update.keyframe
        if keyframe is None or update.T_odom_cam is None:
            return None
        S_map_odom = map_from_odometry(pose, update.T_odom_cam)
        scale = np.float32(S_map_odom.s)
        depth = DepthSamples(
            keyframe.depth.pixels,
            keyframe.depth.inverse_depth / scale,
            keyframe.depth.sigma / scale,
        )
        T_map_cam = sim3.transform_pose(S_map_odom, keyframe.T_odom_cam)
        return Sight(keyframe.frame, T_map_cam, self._surface(S_map_odom), depth)

    def _is_due(self, t_ns: int) -> bool:
        if self._last_ns is None:
            return True
        # Half a millisecond: stamps of a steady camera are not steady to the nanosecond.
        return abs(t_ns - self._last_ns) >= self._changes.interval_s * 1e9 - 500_000

    def _surface(self, S_map_odom: sim3.Sim3) -> Callable[[], F64]:
        return partial(_surface_of, tuple(self._keyframes), self._camera, S_map_odom)


def _surface_of(
    keyframes: Sequence[KeyframeResult], camera: CameraModel, S_map_odom: sim3.Sim3
) -> F64:
    """Points (n, 3) of keyframes in the map."""
    parts = [np.empty((0, 3))]
    for keyframe in keyframes:
        samples = keyframe.depth
        sure = samples.sigma < _SURE_DEPTH * samples.inverse_depth
        pixels = samples.pixels[sure].astype(np.float64)
        rays = np.column_stack((camera.normalise(pixels), np.ones(len(pixels))))
        local = rays / samples.inverse_depth[sure][:, None]
        T = keyframe.T_odom_cam
        parts.append(local @ T[:3, :3].T + T[:3, 3])
    return sim3.transform(S_map_odom, np.concatenate(parts))


def _no_surface() -> F64:
    return np.empty((0, 3))


def colour_of(frame: Frame) -> U8:
    """The image (h, w, 3); grey where the source has no colour."""
    colour = None if frame.colour is None else frame.colour()
    if colour is None:
        colour = np.repeat(frame.image[:, :, None], 3, axis=2)
    return colour
