# SPDX-License-Identifier: Apache-2.0
"""Fixes that were refused, and yet tell the same other place again and again."""

import numpy as np

from edge.config.registration import RegistrationConfig
from edge.registration.constellation import Constellation
from edge.registration.gates import chi2_quantile
from edge.registration.motion import OdometryTrack
from edge.registration.noise import pose_difference
from edge.registration.verdict import FixVerdict, has_pose
from edge.types import F64, Fix

_IN_A_ROW = 3
# An odometry that is drawn along is off by much the same for a while, chance finds are not.
_ALIKE_SHARE = 0.5


class Doubts:
    """Counts them. Owned by one thread.

    What they silence, they cannot free: refused fixes are looked for about the place in doubt, so
    that one of them agrees with it says little, and that they tell other places says nothing.
    """

    def __init__(self, config: RegistrationConfig) -> None:
        self._gate, self._gate_rotation = (
            chi2_quantile(config.gate_probability, freedoms) for freedoms in (6, 3)
        )
        self._offs: list[F64] = []  # (6,) each [m, rad]

    def forget(self) -> None:
        """Begin anew: what the fixes were held against is no more."""
        self._offs.clear()

    def hear(
        self, fix: Fix, verdict: FixVerdict, track: OdometryTrack | None, held: Constellation | None
    ) -> bool:
        """Take a fix; whether enough that were refused speak against the odometry."""
        if verdict.accepted:
            self._offs.clear()
        if fix.found or not has_pose(fix) or track is None or held is None:
            return False
        if fix.odom_id not in (None, track.odom_id) or not track.holds(fix.index):
            return False
        try:
            return self._speaks_against(fix, track, held)
        except np.linalg.LinAlgError:
            return False  # what is as wild as that says nothing of what is held

    def _speaks_against(self, fix: Fix, track: OdometryTrack, held: Constellation) -> bool:
        innovation = held.compare(fix)
        if not innovation.chi2_pose > self._gate:
            self._offs.clear()
            return False
        assert fix.T_map_cam is not None
        T_map_cam = held.locate(track.frame(fix.index)).T_map_cam
        off = pose_difference(fix.T_map_cam, T_map_cam)
        # Rotations that hardly differ may do so alike by an error of map or lens.
        turned = innovation.chi2_rotation > self._gate_rotation
        parts = (slice(3), slice(3, 6))[: 1 + turned]
        if self._offs and not any(_are_alike(self._offs[-1][p], off[p]) for p in parts):
            self._offs.clear()
        self._offs = [*self._offs, off][-_IN_A_ROW:]
        return len(self._offs) == _IN_A_ROW


def _are_alike(one: F64, other: F64) -> bool:
    largest = max(float(np.linalg.norm(one)), float(np.linalg.norm(other)))
    return float(np.linalg.norm(one - other)) <= _ALIKE_SHARE * largest
