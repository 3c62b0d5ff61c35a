# SPDX-License-Identifier: Apache-2.0
"""Stages that know the truth, so that the runtime can be tested by itself."""

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from edge.geometry import se3
from edge.geometry.camera import CameraModel
from edge.types import (
    DepthSamples,
    Fix,
    Frame,
    KeyframePose,
    KeyframeResult,
    MapStart,
    Mat4,
    Moving,
    OdometryState,
    OdometryUpdate,
    Query,
)

CAMERA = CameraModel(64, 48, 50.0, 50.0, 31.5, 23.5)
PERIOD_NS = 33_333_333
SCALE = 2.0  # map metres per odometry unit
KEYFRAME_EVERY = 5
KEYFRAME_DELAY = 1


def true_pose(index: int) -> Mat4:
    """T_map_cam of frame `index`: along a wide curve."""
    turn = 0.01 * index
    return se3.exp([0.0, 0.0, 0.0, 0.0, turn, 0.0]) @ se3.exp([0.03 * index, 0, 1.0, 0, 0, 0])


def odometry_pose(index: int) -> Mat4:
    """T_odom_cam of the same: from the first frame, in its own scale."""
    T = se3.inverse(true_pose(0)) @ true_pose(index)
    T[:3, 3] /= SCALE
    return T


@dataclass
class FrameList:
    """A camera of blank images."""

    count: int
    camera: CameraModel = CAMERA
    rate_hz: float = 30.0
    dropped: int = 0

    def __iter__(self) -> Iterator[Frame]:
        image = np.full((48, 64), 128, np.uint8)
        for index in range(self.count):
            yield Frame(index, index * PERIOD_NS, image)


class TrueOdometry:
    """Follows the truth, with keyframes whose results come late; blind where it is told."""

    def __init__(self, blind: range = range(0)) -> None:
        self._blind = blind
        self._odom_id = 1
        self._frames: dict[int, Frame] = {}
        self.told: list[MapStart] = []
        self.replenished: list[tuple[int, DepthSamples]] = []

    def step(self, frame: Frame) -> OdometryUpdate:
        self._frames[frame.index] = frame
        if frame.index in self._blind:
            self._odom_id = 2
            return OdometryUpdate(frame.index, frame.t_ns, OdometryState.LOST, self._odom_id)
        last = frame.index - KEYFRAME_DELAY
        keyframe = None
        if last in self._frames and last % KEYFRAME_EVERY == 0 and last not in self._blind:
            keyframe = self._result(last)
        return OdometryUpdate(
            index=frame.index,
            t_ns=frame.t_ns,
            state=OdometryState.TRACKING,
            odom_id=self._odom_id,
            T_odom_cam=odometry_pose(frame.index),
            covariance=1e-8 * np.eye(6),
            quality=1.0,
            is_keyframe=frame.index % KEYFRAME_EVERY == 0,
            keyframe=keyframe,
        )

    def hide(self, moving: Moving) -> None:
        """It measures nothing anyway."""

    def begin_at(self, told: MapStart) -> None:
        self.told.append(told)  # a script starts when it says

    def replenish(self, index: int, depth: DepthSamples) -> None:
        self.replenished.append((index, depth))  # a script has no points that could run out

    def forget_map(self) -> None:
        self.told.clear()

    def restart(self) -> None:
        self._odom_id += 1

    def _result(self, index: int) -> KeyframeResult:
        pixels = np.array([[10.0, 10.0], [30.0, 20.0]], np.float32)
        depth = DepthSamples(pixels, np.full(2, 0.5, np.float32), np.full(2, 0.01, np.float32))
        pose = odometry_pose(index)
        return KeyframeResult(self._frames[index], pose, depth, (KeyframePose(index, pose),))


MAP_DEPTH = DepthSamples(
    np.array([[10.0, 10.0]], np.float32), np.full(1, 0.3, np.float32), np.full(1, 0.01, np.float32)
)


@dataclass
class TrueRelocaliser:
    """Finds every frame where it is, each from map keyframes of its own."""

    asked: list[Query] = field(default_factory=list)

    def step(self, query: Query) -> Fix:
        self.asked.append(query)
        index = query.frame.index
        return Fix(
            index=index,
            t_ns=query.frame.t_ns,
            odom_id=query.odom_id,
            T_odom_cam=query.T_odom_cam,
            found=True,
            reason="ok",
            candidates=(index,),
            matches=100,
            inliers=90,
            T_map_cam=true_pose(index),
            covariance=1e-6 * np.eye(6),
            support=(index,),
            log_scale=float(np.log(SCALE)),
            log_scale_sigma=0.01,
            depth_m=3.0,
            depth=MAP_DEPTH,
        )
