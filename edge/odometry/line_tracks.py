# SPDX-License-Identifier: Apache-2.0
"""Segments followed from keyframe to keyframe until they may tell a line."""

from dataclasses import dataclass

import numpy as np

from edge.lines import kernels_associate
from edge.lines.line import Segments, ends
from edge.odometry.keyframe import Keyframe
from edge.types import F64, Bools, Mat4, Pinhole

# Beside what the camera's turn explains: parallax of neighbouring keyframes, as a share of width
# and height together, and what of a segment's samples must meet the next one.
_REACH_SHARE, _MIN_SHARE = 0.025, 0.5
_COSINE = float(np.cos(np.deg2rad(5.0)))
_MIN_VIEWS, _MAX_VIEWS = 3, 6


@dataclass(slots=True, eq=False)
class View:
    """A segment that shows a line, with its keyframe while that is in the window."""

    segments: Segments
    index: int
    keyframe: Keyframe | None
    T: Mat4  # T_cam_odom of a keyframe that left

    @property
    def T_cam_odom(self) -> Mat4:
        """Current estimate."""
        return self.T if self.keyframe is None else self.keyframe.T_cam_odom

    def freeze(self, keyframe: Keyframe, T: Mat4) -> None:
        """Keep the pose of a keyframe that leaves."""
        if self.keyframe is keyframe:
            self.keyframe, self.T = None, T


@dataclass(slots=True, eq=False)
class Track:
    """Views that may show one line."""

    views: list[View]


class KeyframeTracks:
    """Owned by the thread of the keyframe work."""

    def __init__(self, camera: Pinhole) -> None:
        self._camera = camera
        self._reach_px = _REACH_SHARE * (camera.width + camera.height)
        self._open: list[Track] = []  # those that the last keyframe shows

    def step(self, segments: Segments, free: Bools, keyframe: Keyframe) -> list[Track]:
        """Follow into the segments of the next keyframe that are `free` (n,); long tracks."""
        now: list[Track] = []
        follows = self._followed(segments, free, keyframe)
        for k in np.flatnonzero(free):
            view = View(segments, int(k), keyframe, np.eye(4))
            before = follows.get(int(k))
            views = [] if before is None else before.views
            now.append(Track([*views[-_MAX_VIEWS + 1 :], view]))
        self._open = now
        return [track for track in now if len(track.views) >= _MIN_VIEWS]

    def drop(self, track: Track) -> None:
        """Follow a track no longer: it has become a line."""
        self._open.remove(track)

    def freeze(self, keyframe: Keyframe, T: Mat4) -> None:
        """Keep the pose of a keyframe that leaves."""
        for track in self._open:
            for view in track.views:
                view.freeze(keyframe, T)

    def _followed(self, segments: Segments, free: Bools, keyframe: Keyframe) -> dict[int, Track]:
        """Which track each segment carries on."""
        if not self._open:
            return {}
        places = np.array([self._turned(track.views[-1], keyframe) for track in self._open])
        n = len(places)
        match, share, offset = np.empty(n, np.int32), np.empty(n), np.empty(n)
        reach = np.full(n, self._reach_px)
        kernels_associate.vote(places, reach, *segments[:3], _COSINE, match, share, offset)
        found: dict[int, Track] = {}
        for k in np.argsort(np.abs(offset), kind="stable"):
            target = int(match[k])
            if target >= 0 and free[target] and share[k] >= _MIN_SHARE:
                found.setdefault(target, self._open[k])
        return found

    def _turned(self, view: View, keyframe: Keyframe) -> F64:
        """Where ends (4,) go when the camera turns only; NaN behind it."""
        p = self._camera
        R = keyframe.T_cam_odom[:3, :3] @ view.T_cam_odom[:3, :3].T
        pixels = ends(view.segments)[view.index].reshape(2, 2)
        rays = np.column_stack(((pixels - [p.cx, p.cy]) / [p.fx, p.fy], np.ones(2))) @ R.T
        if rays[:, 2].min() < 0.1:
            return np.full(4, np.nan)
        return np.asarray((rays[:, :2] / rays[:, 2:] * [p.fx, p.fy] + [p.cx, p.cy]).ravel())
