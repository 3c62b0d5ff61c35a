# SPDX-License-Identifier: Apache-2.0
"""The filter behind S_map_odom: a camera pose in the map and the odometry's scale.

A Sim(3) between map and odometry is as good as the map pose of one of the odometry's frames
and the logarithm of the scale: that is what is kept, since its uncertainty means something.
The state is carried from frame to frame by the odometry, and each fix corrects it at the
fix's own frame.

Two fixes from one place share their errors, for they rest on the same map points. So a
fix is modelled as truth + common error + white error. The common error is a state of its own,
forgotten as the camera moves on; without it a hundred fixes would look ten times better than one.

Error state (14): position (3) and rotation (3) in map axes, ln scale, and 7 common errors in
units of their own sigma.
"""

import math
from dataclasses import dataclass

import numpy as np

from edge.config.registration import RegistrationConfig
from edge.geometry import se3, so3
from edge.registration.motion import Motion
from edge.types import F64, Fix, Mat4, Mat6

_POSE = 6
_SCALE = 6
_COMMON = 7
_SIZE = 14
# A scale that nothing has told yet: a factor of e either way.
_UNKNOWN_LOG_SCALE_SIGMA = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class Anchor:
    """The state at one frame of the odometry."""

    index: int
    T_map_cam: Mat4
    log_scale: float  # ln(map units per odometry unit)
    common: F64  # (7,) estimate of the common errors [sigmas]
    P: F64  # (14, 14)
    depth_m: float  # size of the scene at the last fix

    @property
    def scale(self) -> float:
        """Map units per odometry unit."""
        return math.exp(self.log_scale)

    @property
    def covariance(self) -> Mat6:
        """Of the position and rotation, in map axes."""
        return self.P[:_POSE, :_POSE]

    @property
    def log_scale_sigma(self) -> float:
        """Standard deviation of `log_scale`."""
        return math.sqrt(self.P[_SCALE, _SCALE])


def pose_difference(T_a: Mat4, T_b: Mat4) -> F64:
    """Position and rotation (6,), in map axes, that lead from T_b to T_a."""
    return np.concatenate((T_a[:3, 3] - T_b[:3, 3], so3.log(T_a[:3, :3] @ T_b[:3, :3].T)))


def start(fix: Fix, log_scale: float, config: RegistrationConfig) -> Anchor:
    """Anchor at the frame of `fix` from it alone.

    `log_scale` is where to linearise; how certain it is, only the fix's own scale tells.
    """
    assert fix.T_map_cam is not None
    assert fix.depth_m is not None
    R7, measured = _noise(fix)
    root = _root(config.common_share * R7)
    P = np.zeros((_SIZE, _SIZE))
    P[:_COMMON, :_COMMON] = R7
    P[:_COMMON, _COMMON:] = -root
    P[_COMMON:, :_COMMON] = -root
    P[_COMMON:, _COMMON:] = np.eye(_COMMON)
    if measured == _POSE:
        P[_SCALE, :] = P[:, _SCALE] = 0.0
        P[_SCALE, _SCALE] = _UNKNOWN_LOG_SCALE_SIGMA**2
    elif fix.log_scale is not None:
        log_scale = fix.log_scale
    return Anchor(fix.index, fix.T_map_cam, log_scale, np.zeros(_COMMON), P, fix.depth_m)


def predict(anchor: Anchor, motion: Motion, index: int, config: RegistrationConfig) -> Anchor:
    """Anchor at the frame `index`, which lies `motion` after that of `anchor`."""
    T_step = motion.T_from_to.copy()
    T_step[:3, 3] *= anchor.scale
    T_map_cam = se3.normalise(anchor.T_map_cam @ T_step)
    moved = T_map_cam[:3, 3] - anchor.T_map_cam[:3, 3]
    path = anchor.scale * motion.path / anchor.depth_m
    forgetting = path / config.common_path_depth_share
    forgetting += motion.turn_rad / math.radians(config.common_turn_deg)
    kept = math.exp(-forgetting)

    F = np.eye(_SIZE)
    F[:3, 3:6] = -so3.hat(moved)
    F[:3, _SCALE] = moved
    F[_COMMON:, _COMMON:] *= kept
    P = F @ anchor.P @ F.T
    noise = np.zeros(_SIZE)
    noise[:3] = (config.drift_position_depth_share * anchor.depth_m) ** 2 * path
    noise[3:6] = config.drift_rotation_rad**2 * (path + motion.turn_rad)
    noise[_SCALE] = config.drift_log_scale**2 * path
    noise[_COMMON:] = 1.0 - kept * kept
    P[np.diag_indices(_SIZE)] += noise
    return Anchor(index, T_map_cam, anchor.log_scale, kept * anchor.common, P, anchor.depth_m)


@dataclass(frozen=True, slots=True, eq=False)
class Innovation:
    """How a fix differs from the anchor at its frame."""

    residual: F64  # (6,) or (7,) with the scale
    H: F64  # (6 or 7, 14)
    white: F64  # (6 or 7, 6 or 7) noise
    chi2_pose: float  # 6 degrees of freedom
    chi2_scale: float  # 1 degree of freedom; 0 without a scale


def compare(anchor: Anchor, fix: Fix, config: RegistrationConfig) -> Innovation:
    """Innovation of `fix` against `anchor`, which is at the fix's frame."""
    assert fix.T_map_cam is not None
    R7, rows = _noise(fix)
    root = _root(config.common_share * R7)
    residual = -root @ anchor.common
    residual[:_POSE] += pose_difference(fix.T_map_cam, anchor.T_map_cam)
    if fix.log_scale is not None:
        residual[_SCALE] += fix.log_scale - anchor.log_scale
    H = np.hstack((np.eye(7), root))
    white = (1.0 - config.common_share) * R7
    S = H @ anchor.P @ H.T + white
    chi2_pose = float(residual[:_POSE] @ np.linalg.solve(S[:_POSE, :_POSE], residual[:_POSE]))
    chi2_scale = residual[_SCALE] ** 2 / S[_SCALE, _SCALE] if rows > _POSE else 0.0
    return Innovation(residual[:rows], H[:rows], white[:rows, :rows], chi2_pose, float(chi2_scale))


def update(anchor: Anchor, fix: Fix, innovation: Innovation, *, use_scale: bool = True) -> Anchor:
    """Anchor corrected by `fix` at its own frame (Joseph form)."""
    rows = len(innovation.residual) if use_scale else _POSE
    H, white = innovation.H[:rows], innovation.white[:rows, :rows]
    S = H @ anchor.P @ H.T + white
    K = np.linalg.solve(S, H @ anchor.P).T
    step = K @ innovation.residual[:rows]
    keep = np.eye(_SIZE) - K @ H
    P = keep @ anchor.P @ keep.T + K @ white @ K.T
    T = anchor.T_map_cam.copy()
    T[:3, 3] += step[:3]
    T[:3, :3] = so3.exp(step[3:6]) @ T[:3, :3]
    return Anchor(
        anchor.index,
        T,
        anchor.log_scale + float(step[_SCALE]),
        anchor.common + step[_COMMON:],
        0.5 * (P + P.T),
        anchor.depth_m if fix.depth_m is None else fix.depth_m,
    )


def _noise(fix: Fix) -> tuple[F64, int]:
    """Covariance (7, 7) of a fix's pose and scale, and how many of its rows were measured.

    The scale from depths was taken at the fix's pose: if that stands too far ahead by dz, the
    map's depths are too small by dz and so is the scale. The two share one error, and the
    covariance says so, for else one piece of information would count twice.
    """
    assert fix.covariance is not None
    R7 = np.eye(7)
    R7[:_POSE, :_POSE] = fix.covariance
    if fix.log_scale is None or fix.log_scale_sigma is None:
        return R7, _POSE
    assert fix.T_map_cam is not None
    assert fix.depth_m is not None
    slope = np.zeros(_POSE)
    slope[:3] = -fix.T_map_cam[:3, 2] / fix.depth_m
    shared = fix.covariance @ slope
    R7[_SCALE, :_POSE] = R7[:_POSE, _SCALE] = shared
    R7[_SCALE, _SCALE] = fix.log_scale_sigma**2 + slope @ shared
    return R7, 7


def _root(C: F64) -> F64:
    """Symmetric square root of a positive semidefinite matrix."""
    values, vectors = np.linalg.eigh(C)
    return np.asarray((vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T, np.float64)
