# SPDX-License-Identifier: Apache-2.0
"""A pose stream without jumps: corrections are taken in small steps."""

import math

import numpy as np

from edge.config.registration import RegistrationConfig
from edge.geometry import se3, so3
from edge.registration.noise import pose_difference
from edge.types import Mat4


class SmoothStream:
    """Follows the exact poses; its own correction per frame is bounded.

    It moves with the odometry and takes a share of what then still lacks, at most one step.
    A gap or too great a correction makes it jump, and `reset_counter` counts that.
    """

    def __init__(self, config: RegistrationConfig) -> None:
        self._config = config
        self._T_map_cam: Mat4 | None = None
        self._begun = False
        self.reset_counter = 0

    def interrupt(self) -> None:
        """Say that a frame had no pose: the next one starts anew."""
        self._T_map_cam = None

    def step(self, T_exact: Mat4, T_step: Mat4 | None) -> Mat4:
        """Smooth pose where the exact one is `T_exact`.

        `T_step` (4, 4) is the camera's motion since the last pose, in map units, by odometry;
        None where nothing links the two.
        """
        if self._T_map_cam is None or T_step is None:
            return self._jump(T_exact)
        T_moved = self._T_map_cam @ T_step
        lack = pose_difference(T_exact, T_moved)
        shift, turn = float(np.linalg.norm(lack[:3])), float(np.linalg.norm(lack[3:]))
        config = self._config
        if shift > config.smooth_jump_m or turn > math.radians(config.smooth_jump_deg):
            return self._jump(T_exact)
        share = config.smooth_share
        share = min(share, config.smooth_step_m / max(shift, 1e-12))
        share = min(share, math.radians(config.smooth_step_deg) / max(turn, 1e-12))
        T = T_moved.copy()
        T[:3, 3] += share * lack[:3]
        T[:3, :3] = so3.normalise(so3.exp(share * lack[3:]) @ T_moved[:3, :3])
        self._T_map_cam = T
        return T

    def _jump(self, T_exact: Mat4) -> Mat4:
        if self._begun:
            self.reset_counter += 1
        self._begun = True
        self._T_map_cam = se3.normalise(T_exact)
        return self._T_map_cam
