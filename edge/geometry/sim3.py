# SPDX-License-Identifier: Apache-2.0
"""Similarities: a scale with a rigid transform, where monocular scale is fixed.

`S_map_odom = (s, R, t)` takes odometry points to the map: `p_map = s R p_odom + t`. A camera pose
goes over as `(R R_oc, s R t_oc + t)` and stays rigid: `transform_pose`. Twists (7,) hold
translation, rotation [rad] and the log of the scale; steps multiply on the left.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from edge.geometry import se3, so3
from edge.types import F64, Mat4

# exp's integrals are smooth: for angles to pi and scales of e^-5 to e^5 this many nodes give
# every digit, and there are no special cases near zero.
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(20)
_TAU, _WEIGHT = 0.5 * (_NODES + 1.0), 0.5 * _WEIGHTS


class Sim3(NamedTuple):
    """Scale s > 0, rotation R (3, 3) float64, translation t (3,) float64."""

    s: float
    R: F64
    t: F64


def identity() -> Sim3:
    """Similarity that moves nothing."""
    return Sim3(1.0, np.eye(3), np.zeros(3))


def from_se3(T: Mat4, s: float = 1.0) -> Sim3:
    """Similarity of the scale s and the rigid transform T (4, 4): `p -> s R p + t`."""
    return Sim3(s, T[:3, :3].copy(), T[:3, 3].copy())


def compose(S_a_b: Sim3, S_b_c: Sim3) -> Sim3:
    """S_a_c: first the right one, then the left one."""
    return Sim3(S_a_b.s * S_b_c.s, S_a_b.R @ S_b_c.R, S_a_b.s * (S_a_b.R @ S_b_c.t) + S_a_b.t)


def inverse(S: Sim3) -> Sim3:
    """S_b_a of S_a_b."""
    R = S.R.T
    return Sim3(1.0 / S.s, R, -(R @ S.t) / S.s)


def transform(S: Sim3, points: F64) -> F64:
    """Points (n, 3) moved by S."""
    return np.asarray(S.s * (points @ S.R.T) + S.t, np.float64)


def transform_pose(S_map_odom: Sim3, T_odom_cam: Mat4) -> Mat4:
    """T_map_cam (4, 4), rigid, of a camera pose in the odometry frame."""
    return se3.from_rotation_translation(
        S_map_odom.R @ T_odom_cam[:3, :3],
        S_map_odom.s * (S_map_odom.R @ T_odom_cam[:3, 3]) + S_map_odom.t,
    )


def exp(zeta: ArrayLike) -> Sim3:
    """Similarity of the twist zeta (7,): translation, rotation, log scale."""
    zeta = np.asarray(zeta, np.float64)
    w, log_s = zeta[3:6], float(zeta[6])
    return Sim3(math.exp(log_s), so3.exp(w), _translation_factor(w, log_s) @ zeta[:3])


def log(S: Sim3) -> F64:
    """Twist (7,) of S, its rotation at most pi."""
    w, log_s = so3.log(S.R), math.log(S.s)
    rho = np.linalg.solve(_translation_factor(w, log_s), S.t)
    return np.concatenate((rho, w, [log_s]))


def adjoint(S: Sim3) -> F64:
    """Ad (7, 7) with `S exp(zeta) == exp(Ad @ zeta) S`.

    Its upper left (6, 6) takes twists and covariances of T_odom_cam to those of T_map_cam.
    """
    Ad = np.zeros((7, 7))
    Ad[:3, :3] = S.s * S.R
    Ad[:3, 3:6] = so3.hat(S.t) @ S.R
    Ad[:3, 6] = -S.t
    Ad[3:6, 3:6] = S.R
    Ad[6, 6] = 1.0
    return Ad


def interpolate(S0: Sim3, S1: Sim3, alpha: float) -> Sim3:
    """Similarity at `alpha` in [0, 1] on the steady motion from S0 to S1; scale is geometric."""
    return compose(exp(alpha * log(compose(S1, inverse(S0)))), S0)


def _translation_factor(w: F64, log_s: float) -> F64:
    """Integral (3, 3) of e^(tau log_s) exp(tau w) over tau in [0, 1]."""
    W = so3.hat(w)
    turn = _TAU * (float(np.linalg.norm(w)) / math.pi)  # np.sinc(x) is sin(pi x) / (pi x)
    growth = _WEIGHT * np.exp(_TAU * log_s)
    a = float(growth.sum())
    b = float(growth @ (_TAU * np.sinc(turn)))
    c = float(growth @ (0.5 * (_TAU * np.sinc(0.5 * turn)) ** 2))
    return np.asarray(a * np.eye(3) + b * W + c * (W @ W), np.float64)
