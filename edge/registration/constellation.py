# SPDX-License-Identifier: Apache-2.0
"""Where a frame is in the map, by all recent fixes at once.

The odometry holds the frames of its window against one another far better than a chain of
single steps would: a keyframe of long ago that is still in the window counts as if it were near.
So nothing is carried from fix to fix. For any frame the recent fixes are brought to it by the
odometry as it is known then, and weighed by how they err:

- each fix has its own error, and one that it shares with those from near by, which rest on the
  same map points: without it a hundred fixes would look ten times better than one;
- the odometry errs by a random field over the places (`fields.drift`).

The best linear unbiased estimate is then one of generalised least squares (kriging), for the
pose of the frame in map axes and the logarithm of the scale.
"""

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from edge.config.registration import RegistrationConfig
from edge.geometry import se3, so3
from edge.registration import fields, turning
from edge.registration.drift_weights import FACTORS, FIRST_WEIGHTS, KNOWN, Drift, System, weighed
from edge.registration.fields import ROWS, Places
from edge.registration.gates import chi2_quantile
from edge.registration.motion import OdometryTrack, TrackedFrame
from edge.registration.noise import noise_of, parts_of, rotation_vectors
from edge.types import F64, Fix, Mat4, Mat6

_POSE = 6


class Estimate(NamedTuple):
    """Where a frame is."""

    T_map_cam: Mat4
    covariance: Mat6  # position and rotation, map axes
    log_scale: float  # ln(map units per odometry unit)
    depth_m: float  # of the scene at the last fix
    drift: Drift

    @property
    def scale(self) -> float:
        """Map units per odometry unit."""
        return math.exp(self.log_scale)


class Innovation(NamedTuple):
    """How a fix differs from what the others foretell."""

    chi2_pose: float  # 6 degrees of freedom
    chi2_rotation: float  # 3 of them, whatever the position
    chi2_scale: float  # 1 degree of freedom, as if no error were common; 0 without a scale


@dataclass(frozen=True, slots=True, eq=False)
class _Held:
    """A fix, its frame, and how it errs."""

    fix: Fix
    frame: TrackedFrame
    R7: F64  # (7, 7)
    rows: int  # 7, or 6 without a scale


class _Parts(NamedTuple):
    """How n fixes err."""

    roots: F64  # (k, n, 7, 7) of what they share, on k levels
    white: F64  # (n, 7, 7) what each has for itself


class _Solved(NamedTuple):
    """Pose and scale of one frame, solved for."""

    revision: int  # of the odometry's keyframes
    frame: TrackedFrame
    T_map_cam: Mat4
    log_scale: float
    P: F64  # (7, 7)


class Constellation:
    """The recent fixes of one odometry frame. Owned by the tracking thread."""

    def __init__(
        self,
        track: OdometryTrack,
        log_scale: float,
        config: RegistrationConfig,
        fixes: Sequence[Fix],
    ) -> None:
        """Start from `fixes`, ordered by frame; `log_scale` is where to linearise."""
        self._track, self._config = track, config
        self._log_scale = log_scale
        self._weights = FIRST_WEIGHTS
        self._solved: _Solved | None = None
        self._held = [self._as_held(fix, use_scale=True) for fix in fixes]
        self._settle()

    @property
    def log_scale(self) -> float:
        """ln(map units per odometry unit) at the newest fix."""
        return self._log_scale

    @property
    def drift(self) -> Drift:
        """How much the odometry drifts."""
        return Drift(*np.sqrt(self._variance_factors).tolist())

    @property
    def n_fixes(self) -> int:
        """How many fixes are held."""
        return len(self._held)

    def is_late(self, index: int) -> bool:
        """Whether the known frame `index` does not come after that of the newest fix."""
        return self._track.frame(index).number <= self._held[-1].frame.number

    def add(self, fix: Fix, *, use_scale: bool = True) -> None:
        """Take in a fix, newer than all that are held."""
        self._held.append(self._as_held(fix, use_scale=use_scale))
        if len(self._held) > self._config.held_fixes:
            del self._held[self._least()]
        self._settle()

    def joined(self, fixes: Sequence[Fix]) -> "Constellation | None":
        """These and `fixes`, which come after them, together; None where one does not fit."""
        pose_gate = chi2_quantile(self._config.gate_probability, 6)
        scale_gate = chi2_quantile(self._config.gate_probability, 1)
        both = copy.copy(self)
        both._held = list(self._held)
        for fix in fixes:
            innovation = both.compare(fix)
            if innovation.chi2_pose > pose_gate or innovation.chi2_scale > scale_gate:
                return None
            both.add(fix)
        return both

    def locate(self, frame: TrackedFrame) -> Estimate:
        """Pose of a tracked frame in the map.

        All is solved for the first frame after news of fixes or keyframes; others that are asked
        for until the next ones hang on that by the odometry.
        """
        if self._solved is None or self._solved.revision != self._track.revision:
            system = self._system(frame, self._held, self._parts)
            self._solved = self._solve(frame, system)
        at = self._solved if self._solved.frame is frame else self._carried(self._solved, frame)
        covariance, depth_m = at.P[:_POSE, :_POSE].copy(), self._depth_m
        return Estimate(at.T_map_cam.copy(), covariance, at.log_scale, depth_m, self.drift)

    def compare(self, fix: Fix) -> Innovation:
        """Innovation of `fix` against those that are held."""
        new = self._as_held(fix, use_scale=True)
        both = [*self._held, new]
        system = self._system(new.frame, both, self._parts_of(both))
        n = len(system.residual) - new.rows
        sigma = system.sigma(self._variance_factors)
        J, y, cross = system.J[:n], system.residual[:n], sigma[:n, n:]
        solved = np.linalg.solve(sigma[:n, :n], np.column_stack((J, y, cross)))
        P = np.linalg.inv(J.T @ solved[:, :ROWS] + KNOWN)
        x = P @ (J.T @ solved[:, ROWS])
        lever = system.J[n:] - cross.T @ solved[:, :ROWS]
        off = system.residual[n:] - cross.T @ solved[:, ROWS] - lever @ x
        S = sigma[n:, n:] - cross.T @ solved[:, ROWS + 1 :] + lever @ P @ lever.T
        parts = slice(_POSE), slice(3, _POSE)
        pose, rotation = (float(off[p] @ np.linalg.solve(S[p, p], off[p])) for p in parts)
        chi2_scale = 0.0
        if new.rows > _POSE:
            told = float(system.residual[-1] - x[6])
            chi2_scale = told**2 / float(P[6, 6] + new.R7[6, 6])
        return Innovation(pose, rotation, chi2_scale)

    @property
    def _variance_factors(self) -> F64:
        return np.asarray(self._weights @ FACTORS**2, np.float64)

    @property
    def _depth_m(self) -> float:
        depth_m = self._held[-1].fix.depth_m
        assert depth_m is not None
        return depth_m

    def _as_held(self, fix: Fix, *, use_scale: bool) -> _Held:
        R7, rows = noise_of(fix)
        return _Held(fix, self._track.frame(fix.index), R7, rows if use_scale else _POSE)

    def _parts_of(self, held: Sequence[_Held]) -> _Parts:
        return _Parts(*parts_of(np.stack([h.R7 for h in held]), self._config))

    def _least(self) -> int:
        """The fix to let go: the oldest that the odometry's window does not hold."""
        oldest = (i for i, h in enumerate(self._held) if not self._track.in_window(h.frame.index))
        return next(oldest, 0)

    def _settle(self) -> None:
        """Learn how much the odometry drifts, and where to linearise."""
        newest = self._held[-1].frame
        self._parts = self._parts_of(self._held)
        system = self._system(newest, self._held, self._parts)
        self._weights = weighed(system, self._weights)
        self._solved = self._solve(newest, system)
        self._log_scale = self._solved.log_scale

    def _solve(self, frame: TrackedFrame, system: System) -> _Solved:
        """Generalised least squares for one frame."""
        sigma = system.sigma(self._variance_factors)
        solved = np.linalg.solve(sigma, np.column_stack((system.J, system.residual)))
        P = np.linalg.inv(system.J.T @ solved[:, :ROWS] + KNOWN)
        x = P @ (system.J.T @ solved[:, ROWS])
        T = self._guess(frame)
        T[:3, 3] += x[:3]
        T[:3, :3] = so3.exp(x[3:6]) @ T[:3, :3]
        log_scale = self._log_scale + float(x[6])
        return _Solved(self._track.revision, frame, se3.normalise(T), log_scale, 0.5 * (P + P.T))

    def _carried(self, at: _Solved, frame: TrackedFrame) -> _Solved:
        """What is solved for one frame, brought to another by the odometry."""
        scale, depth_m = math.exp(at.log_scale), self._depth_m
        T_step = se3.inverse(self._track.place(at.frame)) @ self._track.place(frame)
        T_step[:3, 3] *= scale
        T = se3.normalise(at.T_map_cam @ T_step)
        away = T[:3, 3] - at.T_map_cam[:3, 3]
        F = np.eye(ROWS)
        F[:3, 3:6], F[:3, 6] = -so3.hat(away), away
        places = Places(np.zeros((2, 3)), np.zeros((2, 9)), np.zeros((2, 2)))
        places.position[0], places.turned[0] = (
            T_step[:3, 3] / depth_m,
            fields.turned(T_step[None])[0],
        )
        places.turned[1] = fields.turned(np.eye(4)[None])[0]
        path, turn = frame.path - at.frame.path, frame.turn_rad - at.frame.turn_rad
        places.way[0] = path * scale / depth_m, turn
        drift = fields.drift(places, away[None], depth_m, self._config)
        R_map_odom = scale * at.T_map_cam[:3, :3] @ self._track.place(at.frame)[:3, :3].T
        lost = self._lost(at.frame, [frame], R_map_odom)
        P = F @ at.P @ F.T + np.tensordot(self._variance_factors, drift, 1) + lost
        return at._replace(frame=frame, T_map_cam=T, P=P)

    def _guess(self, frame: TrackedFrame) -> Mat4:
        """Pose of a frame by the newest fix alone: where to linearise."""
        newest = self._held[-1]
        assert newest.fix.T_map_cam is not None
        T_step = se3.inverse(self._track.place(newest.frame)) @ self._track.place(frame)
        T_step[:3, 3] *= math.exp(self._log_scale)
        return se3.normalise(newest.fix.T_map_cam @ T_step)

    def _system(self, frame: TrackedFrame, held: Sequence[_Held], parts: _Parts) -> System:
        """What `held` say of `frame`, at its guess."""
        n, scale, depth_m = len(held), math.exp(self._log_scale), self._depth_m
        T_map_cam, T_cam_odom = self._guess(frame), se3.inverse(self._track.place(frame))
        T_steps = T_cam_odom @ np.stack([self._track.place(h.frame) for h in held])
        T_steps[:, :3, 3] *= scale
        T_foretold = T_map_cam @ T_steps
        away = T_foretold[:, :3, 3] - T_map_cam[:3, 3]
        J = np.tile(np.eye(ROWS), (n, 1, 1))
        J[:, :3, 3:6], J[:, :3, 6] = -fields.hats(away), away
        T_told = np.stack([h.fix.T_map_cam for h in held if h.fix.T_map_cam is not None])
        residual = np.empty((n, ROWS))
        residual[:, :3] = T_told[:, :3, 3] - T_foretold[:, :3, 3]
        residual[:, 3:6] = rotation_vectors(
            T_told[:, :3, :3] @ T_foretold[:, :3, :3].swapaxes(1, 2)
        )
        residual[:, 6] = [(h.fix.log_scale or 0.0) - self._log_scale for h in held]
        ways = [(h.frame.path - frame.path, h.frame.turn_rad - frame.turn_rad) for h in held]
        places = Places(
            np.vstack((T_steps[:, :3, 3] / depth_m, np.zeros(3))),
            fields.turned(np.concatenate((T_steps, np.eye(4)[None]))),
            np.vstack((ways, np.zeros(2))) * (scale / depth_m, 1.0),
        )
        of_fixes = Places(*(column[:n] for column in places))
        noise = fields.shared(parts.roots, of_fixes, self._config)
        for i, white in enumerate(parts.white):
            noise[ROWS * i : ROWS * (i + 1), ROWS * i : ROWS * (i + 1)] += white
        R_map_odom = scale * T_map_cam[:3, :3] @ T_cam_odom[:3, :3]
        noise += self._lost(frame, [h.frame for h in held], R_map_odom)
        drift = fields.drift(places, away, depth_m, self._config)
        used = np.concatenate([np.arange(ROWS) < h.rows for h in held])
        return System(residual.ravel(), J.reshape(-1, ROWS), noise, drift).only(used)

    def _lost(self, frame: TrackedFrame, others: Sequence[TrackedFrame], R: F64) -> F64:
        """Covariance (7 n, 7 n) of what turns cost between `frame` and `others`.

        R  (3, 3)  takes odometry axes and units to those of the map
        """
        numbers = np.array([other.number for other in others])
        spans = (min(numbers.min(), frame.number), max(numbers.max(), frame.number))
        losses = self._track.turns.between(*spans)
        if not losses:
            return np.zeros((ROWS * len(others),) * 2)
        places = np.stack([self._track.place(other)[:3, 3] for other in others])
        offsets = places[:, None] - np.stack([loss.position for loss in losses])
        return turning.covariance(losses, numbers, frame.number, offsets @ R.T)
