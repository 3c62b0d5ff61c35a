# SPDX-License-Identifier: Apache-2.0
"""The pose of a camera that stands still, from the map alone, while there is no odometry."""

from collections import deque
from collections.abc import Sequence

import numpy as np

from edge.config.registration import RegistrationConfig
from edge.geometry import so3
from edge.registration.gates import chi2_quantile
from edge.registration.noise import pose_difference
from edge.types import Fix, Mat4, Mat6

_KEPT = 12  # enough to average noise away, few enough to notice a slow push


class Rest:
    """Decides from fixes alone whether the camera stands still, and where.

    Fixes of one view are one vote: that they agree proves rest, not that they are right.
    So it asks for more of them than a moving camera needs, and for smaller spread.
    """

    def __init__(self, config: RegistrationConfig) -> None:
        self._config = config
        self._fixes: deque[Fix] = deque(maxlen=_KEPT)

    @property
    def depth_m(self) -> float:
        """Depth of the scene at the last fix."""
        depth_m = self._fixes[-1].depth_m
        assert depth_m is not None
        return depth_m

    def clear(self) -> None:
        """Forget everything: the camera has moved."""
        self._fixes.clear()

    def accept(self, fix: Fix) -> str:
        """Take in a fix; return 'ok' when the camera is at rest, or why that is not known."""
        if self._fixes and fix.index == self._fixes[-1].index:
            return "older than the last"
        self._fixes.append(fix)
        while not self._consistent():
            self._fixes.popleft()
        return "ok" if self._proven() else "awaiting agreement"

    def locate(self, t_ns: int, newest: Sequence[int]) -> tuple[Mat4, Mat6] | None:
        """T_map_cam and its covariance at `t_ns`, or None.

        `newest` are the indices of the last frames, this one last.
        """
        held = tuple(newest)[-self._config.rest_hold_frames :]
        if not self._proven() or self._fixes[-1].index not in held:
            return None
        age_s = abs(t_ns - self._fixes[-1].t_ns) * 1e-9  # time falls in a reversed replay
        T, covariance = self._mean()
        unseen = (self._config.rest_speed_depths_per_s * age_s) ** 2
        growth = np.repeat((unseen * self.depth_m**2, unseen), 3)
        return T, covariance + np.diag(growth)

    def _proven(self) -> bool:
        if len(self._fixes) < self._config.rest_fixes:
            return False
        span_ns = abs(self._fixes[-1].t_ns - self._fixes[0].t_ns)
        return span_ns * 1e-9 >= self._config.rest_span_s

    def _mean(self) -> tuple[Mat4, Mat6]:
        """Mean pose and the mean covariance: one view's fixes share their errors."""
        poses = [fix.T_map_cam for fix in self._fixes if fix.T_map_cam is not None]
        offset = np.mean([pose_difference(T, poses[0]) for T in poses], axis=0)
        T = poses[0].copy()
        T[:3, 3] += offset[:3]
        T[:3, :3] = so3.exp(offset[3:]) @ T[:3, :3]
        return T, np.mean([f.covariance for f in self._fixes if f.covariance is not None], axis=0)

    def _consistent(self) -> bool:
        """Whether all fixes lie where one standing camera would have them."""
        if len(self._fixes) < 2:
            return True
        T, _ = self._mean()
        gate = chi2_quantile(self._config.gate_probability, 6)
        for fix in self._fixes:
            assert fix.T_map_cam is not None
            assert fix.covariance is not None
            assert fix.depth_m is not None
            off = pose_difference(fix.T_map_cam, T)
            if np.linalg.norm(off[:3]) > self._config.rest_depth_share * fix.depth_m:
                return False
            if np.linalg.norm(off[3:]) > self._config.rest_depth_share:
                return False
            if off @ np.linalg.solve(fix.covariance, off) > gate:
                return False
        return True
