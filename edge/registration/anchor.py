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
from typing import NamedTuple

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
FACTORS = np.array([0.1, 0.2, 0.4, 0.8, 1.6])
_FIRST_WEIGHTS = np.array([0.01, 0.04, 0.15, 0.5, 0.3])
_FORGETTING = 0.97  # of what was learnt, a fix
_TRUST = 0.3  # in a likelihood: fixes share errors, so each tells less than it seems to
_LEAST_WEIGHT = 1e-4  # no factor is ruled out for ever


class Drift(NamedTuple):
    """How much the odometry drifts here, learnt from how well it foretells the fixes.

    Cameras differ tenfold: a rolling shutter bends what a global one keeps. So the drift is
    one of FACTORS times that of the configuration, each as likely as it explained the past.
    """

    weights: F64  # (5,) of sum 1
    added: F64  # (14, 14) what a factor of 1 has added to P since the last correction

    @property
    def variance_factor(self) -> float:
        """Mean of the squared factor."""
        return float(self.weights @ FACTORS**2)


@dataclass(frozen=True, slots=True, eq=False)
class Anchor:
    """The state at one frame of the odometry."""

    index: int
    T_map_cam: Mat4
    log_scale: float  # ln(map units per odometry unit)
    common: F64  # (7,) estimate of the common errors [sigmas]
    P: F64  # (14, 14)
    depth_m: float  # size of the scene at the last fix
    drift: Drift

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
    root, white = _parts(R7, config)
    P = np.zeros((_SIZE, _SIZE))
    P[:_COMMON, :_COMMON] = root @ root + white
    P[:_COMMON, _COMMON:] = -root
    P[_COMMON:, :_COMMON] = -root
    P[_COMMON:, _COMMON:] = np.eye(_COMMON)
    if measured == _POSE:
        P[_SCALE, :] = P[:, _SCALE] = 0.0
        P[_SCALE, _SCALE] = _UNKNOWN_LOG_SCALE_SIGMA**2
    elif fix.log_scale is not None:
        log_scale = fix.log_scale
    drift = Drift(_FIRST_WEIGHTS, np.zeros((_SIZE, _SIZE)))
    return Anchor(fix.index, fix.T_map_cam, log_scale, np.zeros(_COMMON), P, fix.depth_m, drift)


def predict(anchor: Anchor, motion: Motion, index: int, config: RegistrationConfig) -> Anchor:
    """Anchor at the frame `index`, which lies `motion` after that of `anchor`."""
    T_step = motion.T_from_to.copy()
    T_step[:3, 3] *= anchor.scale
    T_map_cam = se3.normalise(anchor.T_map_cam @ T_step)
    moved = T_map_cam[:3, 3] - anchor.T_map_cam[:3, 3]
    path = anchor.scale * motion.path / anchor.depth_m
    forgetting = path / config.common_path_depth_share
    forgetting += motion.turn_rad / math.radians(config.common_turn_deg)
    kept = np.full(_COMMON, math.exp(-forgetting))
    kept[_SCALE] = math.exp(-forgetting / config.common_scale_keeps)

    F = np.eye(_SIZE)
    F[:3, 3:6] = -so3.hat(moved)
    F[:3, _SCALE] = moved
    F[_COMMON:, _COMMON:] = np.diag(kept)
    added = _drift(moved, path, motion.turn_rad, anchor.depth_m, config)
    P = F @ anchor.P @ F.T + anchor.drift.variance_factor * added
    P[np.arange(_COMMON, _SIZE), np.arange(_COMMON, _SIZE)] += 1.0 - kept * kept
    drift = anchor.drift._replace(added=F @ anchor.drift.added @ F.T + added)
    common = kept * anchor.common
    return Anchor(index, T_map_cam, anchor.log_scale, common, P, anchor.depth_m, drift)


def _drift(
    moved: F64, path: float, turn_rad: float, depth_m: float, config: RegistrationConfig
) -> F64:
    """Covariance (14, 14) that the odometry adds on a way.

    Rotation and scale walk at random while the camera moves, so a third of their variance at
    the end is in the position already, and half in its correlation with them.
    """
    position = (config.drift_position_depth_share * depth_m) ** 2 * path
    rotation = config.drift_rotation_rad**2 * (path + turn_rad)
    log_scale = config.drift_log_scale**2 * path
    lever = np.column_stack((-so3.hat(moved), moved))
    walk = np.diag((rotation, rotation, rotation, log_scale))
    added = np.zeros((_SIZE, _SIZE))
    added[:3, :3] = position * np.eye(3) + lever @ walk @ lever.T / 3.0
    added[:3, 3:_COMMON] = 0.5 * lever @ walk
    added[3:_COMMON, :3] = added[:3, 3:_COMMON].T
    added[3:_COMMON, 3:_COMMON] = walk
    return added


@dataclass(frozen=True, slots=True, eq=False)
class Innovation:
    """How a fix differs from the anchor at its frame."""

    residual: F64  # (6,) or (7,) with the scale
    H: F64  # (6 or 7, 14)
    white: F64  # (6 or 7, 6 or 7) noise
    chi2_pose: float  # 6 degrees of freedom
    chi2_scale: float  # 1 degree of freedom, as if no error were common; 0 without a scale


def compare(anchor: Anchor, fix: Fix, config: RegistrationConfig) -> Innovation:
    """Innovation of `fix` against `anchor`, which is at the fix's frame."""
    assert fix.T_map_cam is not None
    R7, rows = _noise(fix)
    root, white = _parts(R7, config)
    residual = -root @ anchor.common
    residual[:_POSE] += pose_difference(fix.T_map_cam, anchor.T_map_cam)
    if fix.log_scale is not None:
        residual[_SCALE] += fix.log_scale - anchor.log_scale
    H = np.hstack((np.eye(7), root))
    S = H @ anchor.P @ H.T + white
    chi2_pose = float(residual[:_POSE] @ np.linalg.solve(S[:_POSE, :_POSE], residual[:_POSE]))
    chi2_scale = 0.0
    if fix.log_scale is not None and rows > _POSE:
        variance = anchor.P[_SCALE, _SCALE] + R7[_SCALE, _SCALE]
        chi2_scale = (fix.log_scale - anchor.log_scale) ** 2 / variance
    return Innovation(residual[:rows], H[:rows], white[:rows, :rows], chi2_pose, float(chi2_scale))


def needs_depths(anchor: Anchor, config: RegistrationConfig) -> bool:
    """Whether the scale is so uncertain that a fix's depths shall tell it."""
    return anchor.log_scale_sigma > config.depths_until_log_scale_sigma


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
        _learnt(anchor, innovation),
    )


def _learnt(anchor: Anchor, innovation: Innovation) -> Drift:
    """Drift after an accepted fix: each factor gains by how likely it made the innovation."""
    H, r = innovation.H[:_POSE], innovation.residual[:_POSE]
    added = H @ anchor.drift.added @ H.T
    S = H @ anchor.P @ H.T + innovation.white[:_POSE, :_POSE]
    S = S - anchor.drift.variance_factor * added
    log_likelihood = np.empty(len(FACTORS))
    for n, factor in enumerate(FACTORS):
        S_factor = S + factor**2 * added
        chi2 = r @ np.linalg.solve(S_factor, r)
        log_likelihood[n] = -0.5 * (chi2 + np.linalg.slogdet(S_factor)[1])
    log_weights = _FORGETTING * np.log(anchor.drift.weights) + _TRUST * log_likelihood
    weights = np.exp(log_weights - log_weights.max())
    weights = np.maximum(weights / weights.sum(), _LEAST_WEIGHT)
    return Drift(weights / weights.sum(), np.zeros((_SIZE, _SIZE)))


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


def _parts(R7: F64, config: RegistrationConfig) -> tuple[F64, F64]:
    """Root (7, 7) of the common part of a fix's covariance, and its white part (7, 7)."""
    share = np.full(_COMMON, config.common_share)
    share[_SCALE] = config.common_scale_share
    common, white = np.sqrt(share), np.sqrt(1.0 - share)
    return _root(R7 * np.outer(common, common)), R7 * np.outer(white, white)


def _root(C: F64) -> F64:
    """Symmetric square root of a positive semidefinite matrix."""
    values, vectors = np.linalg.eigh(C)
    return np.asarray((vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T, np.float64)
