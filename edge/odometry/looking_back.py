# SPDX-License-Identifier: Apache-2.0
"""Frames from before a start, tracked once there is something to track them against."""

from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from edge.config.odometry import OdometryConfig
from edge.geometry import se3
from edge.image.pyramid import PyramidBuilder
from edge.odometry import kernels_window as kw
from edge.odometry.keyframe import Keyframe
from edge.odometry.map_start import FIRST_RESIDUAL_GREY
from edge.odometry.reference import Reference, make_reference
from edge.odometry.tracker import Tracker, is_believable, motion_guesses
from edge.odometry.window import Window
from edge.odometry.window_points import project
from edge.types import F32, Frame, KeyframePose, Mat4

# Frames that are looked at beside each new one: the work must not hold up that of keyframes.
_AT_ONCE = 2
_MAX_FAILURES = 3  # in a row, after which the others are let go
# Further back less and less of the window's points is in view, and poses bend unnoticed.
_MIN_VISIBLE_SHARE = 0.4
# Where edges are all there is, poses slip as soon as some of them are hidden: frames that were
# right agreed with 0.93 of their points and more, wrong ones with 0.72 to 0.88.
_MIN_INLIER_SHARE = 0.9
# Nor does the camera leave the way that it came by so much from a frame to the next [depths].
_MAX_LEAP_DEPTHS = 0.05


class _Found(NamedTuple):
    """A frame and the keyframe that carries it."""

    frame: Frame
    keyframe: Keyframe
    T_keyframe_cam: Mat4


class _Base(NamedTuple):
    """A keyframe to track against, with the window's points in it."""

    keyframe: Keyframe
    projected: F32  # (3, n) u, v, inverse depth
    weight: F32  # (n,)


class LookingBack:
    """Owned by the thread of the keyframe work.

    Begins at the first window and goes back in time, each frame from where the one after it was.
    """

    def __init__(self, builder: PyramidBuilder, tracker: Tracker, config: OdometryConfig) -> None:
        self._builder, self._tracker, self._config = builder, tracker, config
        self.forget()

    def forget(self) -> None:
        """Let all go."""
        self._left: deque[Frame] = deque()  # newest first
        self._found: list[_Found] = []
        self._bases: list[_Base] = []
        self._references: list[Reference] = []  # made of the bases when they are needed first
        self._failures = 0

    def begin(self, frames: Sequence[Frame], window: Window) -> None:
        """Look at `frames`, oldest first, the first window's keyframes among them."""
        self.forget()
        self._left.extend(reversed(frames))
        self._keyframes = {k.frame.index: k for k in window.keyframes}
        newest = window.keyframes[-1]
        self._bases = [_base(window, k) for k in {0, len(window.keyframes) - 1}]
        self._at, self._T_odom_cam, self._affine = newest.frame, newest.T_odom_cam, newest.affine
        self._step, self._residual_grey = np.zeros(6), FIRST_RESIDUAL_GREY

    def step(self) -> None:
        """Look at some more."""
        if self._left and not self._references:
            self._references = [self._reference(base) for base in self._bases]
        for _ in range(min(_AT_ONCE, len(self._left))):
            frame = self._left.popleft()
            if (keyframe := self._keyframes.get(frame.index)) is not None:
                self._go_on(frame, keyframe.T_odom_cam)
                self._found.append(_Found(frame, keyframe, np.eye(4)))
            elif not self._look(frame):
                self._failures += 1
            if self._failures > _MAX_FAILURES:
                self._left.clear()
                return

    def remake(self) -> None:
        """From now on images are made otherwise: what they are held against must be, too."""
        self._references.clear()

    def take(self) -> tuple[KeyframePose, ...]:
        """What was found since the last call, by keyframes as the window knows them now."""
        found, self._found = self._found, []
        return tuple(
            KeyframePose(f.frame.index, f.keyframe.T_odom_cam @ f.T_keyframe_cam, f.frame.t_ns)
            for f in found
        )

    def _look(self, frame: Frame) -> bool:
        """Track one frame; whether that is to be believed."""
        reference = min(self._references, key=lambda r: abs(r.index - frame.index))
        T_cam_reference = se3.inverse(self._T_odom_cam) @ reference.T_odom_cam
        expected = se3.exp(abs(self._at.index - frame.index) * self._step)
        tracked = self._tracker.track(
            self._builder.build(frame.image),
            reference,
            motion_guesses(T_cam_reference, expected),
            self._affine,
            self._residual_grey,
        )
        if tracked.visible_share < _MIN_VISIBLE_SHARE or tracked.inlier_share < _MIN_INLIER_SHARE:
            return False
        if not is_believable(tracked, reference, self._config):
            return False
        T_keyframe_cam = se3.inverse(tracked.T_cam_reference)
        T_odom_cam = reference.T_odom_cam @ T_keyframe_cam
        leap = T_odom_cam[:3, 3] - (self._T_odom_cam @ se3.inverse(expected))[:3, 3]
        if float(np.linalg.norm(leap)) * reference.inverse_depth > _MAX_LEAP_DEPTHS:
            return False
        self._go_on(frame, T_odom_cam)
        self._affine, self._residual_grey = tracked.affine, max(2.0, tracked.residual_grey)
        self._found.append(_Found(frame, self._keyframes[reference.index], T_keyframe_cam))
        return True

    def _reference(self, base: _Base) -> Reference:
        keyframe = base.keyframe
        return make_reference(
            keyframe.frame.index,
            keyframe.T_odom_cam,
            keyframe.affine,
            self._builder.build(keyframe.frame.image, keyframe.turning),
            self._builder.masks,
            self._builder.pinholes,
            base.projected,
            base.weight,
        )

    def _go_on(self, frame: Frame, T_odom_cam: Mat4) -> None:
        """Take over a pose and the motion to it."""
        apart = abs(self._at.index - frame.index)
        if apart:
            self._step = se3.log(se3.inverse(T_odom_cam) @ self._T_odom_cam) / apart
        self._at, self._T_odom_cam, self._failures = frame, T_odom_cam, 0


def _base(window: Window, number: int) -> _Base:
    use = (window.residual[number] == kw.INLIER) | (window.host == number)
    weight = np.where(use, np.sqrt(window.depth_information), np.float32(0.0))
    return _Base(window.keyframes[number], project(window, number), weight)
