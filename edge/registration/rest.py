# SPDX-License-Identifier: Apache-2.0
"""The pose of a camera that stands still or moves slowly, from the map alone, without odometry."""

from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from edge.config.registration import RegistrationConfig
from edge.geometry import so3
from edge.registration.agreement import long_enough
from edge.registration.gates import chi2_quantile
from edge.registration.noise import pose_difference
from edge.types import F64, Fix, Mat4, Mat6

_KEPT = 12  # enough to average noise away, few enough to notice a slow push


class _Course(NamedTuple):
    """Even motion that some fixes agree with."""

    t_ns: int
    T_map_cam: Mat4  # then
    velocity: F64  # (6,) of position and rotation in map axes [1/s]

    def at(self, t_ns: int) -> Mat4:
        step = self.velocity * ((t_ns - self.t_ns) * 1e-9)
        T = self.T_map_cam.copy()
        T[:3, 3] += step[:3]
        T[:3, :3] = so3.exp(step[3:]) @ T[:3, :3]
        return T


class Rest:
    """Decides from fixes alone whether the camera is at rest or all but, and where.

    Fixes of nearly one view are nearly one vote: that they agree proves rest or a slow and even
    motion, not that they are right. So it asks for more of them than a moving camera with
    odometry needs, and for smaller spread.
    """

    def __init__(self, config: RegistrationConfig) -> None:
        self._config = config
        self._fixes: deque[Fix] = deque(maxlen=_KEPT)
        self._course: _Course | None = None

    @property
    def depth_m(self) -> float:
        """Depth of the scene at the last fix."""
        depth_m = self._fixes[-1].depth_m
        assert depth_m is not None
        return depth_m

    @property
    def founding(self) -> Fix | None:
        """The last fix with depths since which those after it prove the course; or none."""
        if self._course is None or not self._proven():
            return None
        least = self._config.rest_fixes + bool(np.any(self._course.velocity))
        first = next(iter(long_enough(list(self._fixes), least, self._config)), None)
        return None if first is None or first.depth is None else first

    def clear(self) -> None:
        """Forget everything: the camera has moved."""
        self._fixes.clear()
        self._course = None

    def accept(self, fix: Fix) -> str:
        """Take in a fix; return 'ok' when the camera is at rest, or why that is not known."""
        if self._fixes and fix.index == self._fixes[-1].index:
            return "older than the last"
        self._fixes.append(fix)
        while (course := self._found()) is None:
            self._fixes.popleft()
        self._course = course
        return "ok" if self._proven() else "awaiting agreement"

    def locate(self, t_ns: int, newest: Sequence[int]) -> tuple[Mat4, Mat6] | None:
        """T_map_cam and its covariance at `t_ns`, or None.

        `newest` are the indices of the last frames, this one last.
        """
        held = tuple(newest)[-self._config.rest_hold_frames :]
        if self._course is None or not self._proven() or self._fixes[-1].index not in held:
            return None
        covariance = self._mean_covariance()
        times_s = np.array([(fix.t_ns - t_ns) * 1e-9 for fix in self._fixes])
        if np.any(self._course.velocity):
            # Errors that they share do not touch the velocity.
            own, off_s = 1.0 - self._config.common_share, times_s - times_s.mean()
            covariance = covariance * (1.0 + own * times_s.mean() ** 2 / (off_s @ off_s))
        half = 0.5 * times_s[-1] ** 2
        shift = half * self._config.rest_depths_per_s2 * self.depth_m
        turn = half * self._config.rest_rad_per_s2
        growth = np.repeat((shift**2, turn**2), 3)
        return self._course.at(t_ns), covariance + np.diag(growth)

    def _proven(self) -> bool:
        moving = self._course is not None and bool(np.any(self._course.velocity))
        if len(self._fixes) < self._config.rest_fixes + moving:
            return False
        span_ns = abs(self._fixes[-1].t_ns - self._fixes[0].t_ns)
        return span_ns * 1e-9 >= self._config.rest_span_s

    def _found(self) -> _Course | None:
        """The course of all fixes that are held: none at all if there is one such, else slow."""
        poses = [fix.T_map_cam for fix in self._fixes if fix.T_map_cam is not None]
        times_ns = np.array([fix.t_ns for fix in self._fixes], np.int64)
        offs = np.array([pose_difference(T, poses[0]) for T in poses])
        middle_ns = int(times_ns[0] + (times_ns - times_ns[0]).mean())
        standing = poses[0].copy()
        standing[:3, 3] += offs[:, :3].mean(axis=0)
        standing[:3, :3] = so3.exp(offs[:, 3:].mean(axis=0)) @ standing[:3, :3]
        course = _Course(middle_ns, standing, np.zeros(6))
        if self._fits(course):
            return course
        apart_s = (times_ns - middle_ns) * 1e-9
        course = course._replace(velocity=apart_s @ offs / (apart_s @ apart_s))
        return course if self._is_slow(course) and self._fits(course) else None

    def _is_slow(self, course: _Course) -> bool:
        speed = float(np.linalg.norm(course.velocity[:3])) / self.depth_m
        turn = float(np.linalg.norm(course.velocity[3:]))
        return speed < self._config.slow_depths_per_s and turn < self._config.slow_rad_per_s

    def _mean_covariance(self) -> Mat6:
        """Fixes of one view share their errors: their mean is not much better than each."""
        told = [fix.covariance for fix in self._fixes if fix.covariance is not None]
        return np.asarray(np.mean(told, axis=0), np.float64)

    def _fits(self, course: _Course) -> bool:
        """Whether all fixes lie where the course would have them."""
        gate = chi2_quantile(self._config.gate_probability, 6)
        for fix in self._fixes:
            assert fix.T_map_cam is not None
            assert fix.covariance is not None
            assert fix.depth_m is not None
            off = pose_difference(fix.T_map_cam, course.at(fix.t_ns))
            if np.linalg.norm(off[:3]) > self._config.rest_depth_share * fix.depth_m:
                return False
            if np.linalg.norm(off[3:]) > self._config.rest_depth_share:
                return False
            if off @ np.linalg.solve(fix.covariance, off) > gate:
                return False
        return True
