# SPDX-License-Identifier: Apache-2.0
"""Rigid transforms (4, 4) float64 and their twists (6,): translation first, then rotation.

Steps multiply on the left, `exp(xi) @ T`, and covariances are those of such xi.
"""

import numpy as np
from numpy.typing import ArrayLike

from edge.geometry import so3
from edge.types import F64, Mat4, Mat6


def from_rotation_translation(R: F64, t: ArrayLike) -> Mat4:
    """Transform (4, 4) of the rotation R (3, 3) and the translation t (3,)."""
    T = np.eye(4)
    T[:3, :3] = R
    T[:3, 3] = t
    return T


def exp(xi: ArrayLike) -> Mat4:
    """Transform (4, 4) of the twist xi (6,)."""
    xi = np.asarray(xi, np.float64)
    rho, w = xi[:3], xi[3:]
    return from_rotation_translation(so3.exp(w), so3.left_jacobian(w) @ rho)


def log(T: Mat4) -> F64:
    """Twist (6,) of T, its rotation at most pi."""
    w = so3.log(T[:3, :3])
    return np.concatenate((so3.left_jacobian_inverse(w) @ T[:3, 3], w))


def inverse(T: Mat4) -> Mat4:
    """Inverse (4, 4) of a rigid T, without a solver."""
    R = T[:3, :3].T
    return from_rotation_translation(R, -R @ T[:3, 3])


def adjoint(T: Mat4) -> Mat6:
    """Ad (6, 6) with `T @ exp(xi) == exp(Ad @ xi) @ T`; carries twists and covariances over T."""
    R = T[:3, :3]
    Ad = np.zeros((6, 6))
    Ad[:3, :3] = Ad[3:, 3:] = R
    Ad[:3, 3:] = so3.hat(T[:3, 3]) @ R
    return Ad


def left_jacobian(xi: ArrayLike) -> Mat6:
    """J (6, 6) with `exp(xi + dxi) == exp(J @ dxi) @ exp(xi)` to first order."""
    xi = np.asarray(xi, np.float64)
    J = np.zeros((6, 6))
    J[:3, :3] = J[3:, 3:] = so3.left_jacobian(xi[3:])
    J[:3, 3:] = _coupling(xi)
    return J


def left_jacobian_inverse(xi: ArrayLike) -> Mat6:
    """Inverse (6, 6) of `left_jacobian`: `log(exp(d) @ T) == log(T) + J^-1 @ d` to first order."""
    xi = np.asarray(xi, np.float64)
    inner = so3.left_jacobian_inverse(xi[3:])
    J = np.zeros((6, 6))
    J[:3, :3] = J[3:, 3:] = inner
    J[:3, 3:] = -inner @ _coupling(xi) @ inner
    return J


def interpolate(T0: Mat4, T1: Mat4, alpha: float) -> Mat4:
    """Transform at `alpha` in [0, 1] on the screw motion from T0 to T1; beyond, it extrapolates."""
    return exp(alpha * log(T1 @ inverse(T0))) @ T0


def normalise(T: Mat4) -> Mat4:
    """T with its rotation made orthogonal again, as after many products."""
    return from_rotation_translation(so3.normalise(T[:3, :3]), T[:3, 3])


def transform(T: Mat4, points: F64) -> F64:
    """Points (n, 3) moved by T: `p_a = T_a_b @ p_b`."""
    return np.asarray(points @ T[:3, :3].T + T[:3, 3], np.float64)


def from_quaternion_translation(q_xyzw: ArrayLike, t: ArrayLike) -> Mat4:
    """Transform (4, 4) of a quaternion (4,) x y z w and a translation (3,)."""
    return from_rotation_translation(so3.from_quaternion_xyzw(q_xyzw), t)


def from_tum(row: ArrayLike) -> Mat4:
    """Transform (4, 4) of `tx ty tz qx qy qz qw` (7,)."""
    row = np.asarray(row, np.float64)
    return from_quaternion_translation(row[3:7], row[:3])


def to_tum(T: Mat4) -> F64:
    """`tx ty tz qx qy qz qw` (7,) of T, with qw >= 0."""
    return np.concatenate((T[:3, 3], so3.to_quaternion_xyzw(T[:3, :3])))


def _coupling(xi: F64) -> F64:
    """Block Q (3, 3) of the left Jacobian, from rotation to translation (Barfoot 2017, 7.86)."""
    rho, w = xi[:3], xi[3:]
    P, W = so3.hat(rho), so3.hat(w)
    b, c, d = _coupling_ratios(float(np.linalg.norm(w)))
    WP, PW = W @ P, P @ W
    WPW = W @ PW
    return np.asarray(
        0.5 * P + b * (WP + PW + WPW) + c * (W @ WP + PW @ W - 3.0 * WPW) + d * (WPW @ W + W @ WPW),
        np.float64,
    )


def _coupling_ratios(theta: float) -> tuple[float, float, float]:
    """Return the three scalars of Barfoot's Q; their series below 0.5 rad, where digits cancel."""
    s = theta * theta
    if theta < 0.5:
        b = (1 - s / 20 * (1 - s / 42 * (1 - s / 72 * (1 - s / 110)))) / 6
        c = (1 - s / 30 * (1 - s / 56 * (1 - s / 90 * (1 - s / 132)))) / 24
        d = (1 - s / 21 * (1 - s / 48 * (1 - s / 82.5 * (1 - s / 124.8)))) / 120
        return b, c, d
    sine, cosine = np.sin(theta), np.cos(theta)
    b = (theta - sine) / theta**3
    c = (0.5 * s + cosine - 1.0) / theta**4
    d = 0.5 * (c + 3.0 * (theta - sine - theta**3 / 6.0) / theta**5)
    return float(b), float(c), float(d)
