# SPDX-License-Identifier: Apache-2.0
"""Rotations: exponential, logarithm, Jacobians and quaternions; all float64.

Every function is accurate from angle zero to pi. Quaternions exist on the wire
only; their order stands in the name.
"""

import math

import numpy as np
from numpy.typing import ArrayLike

from edge.types import F64

# Below this angle [rad] the closed forms cancel digits and their series are exact to 1e-15.
_SERIES_BELOW_RAD = 0.3


def hat(w: ArrayLike) -> F64:
    """Skew matrix (3, 3) with `hat(w) @ p == cross(w, p)`, of w (3,)."""
    x, y, z = np.asarray(w, np.float64)
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def exp(w: ArrayLike) -> F64:
    """Rotation matrix (3, 3) by the angle |w| [rad] about the axis w (3,)."""
    x, y, z = _listed(w)
    theta = math.hypot(x, y, z)
    return _combined((x, y, z), _sin_ratio(theta), _cos_ratio(theta))


def log(R: F64) -> F64:
    """Rotation vector (3,) [rad] of R (3, 3), its length in [0, pi]."""
    q = to_quaternion_xyzw(R)
    sine, cosine = float(np.linalg.norm(q[:3])), float(q[3])
    if sine < 1e-12:
        return 2.0 / cosine * q[:3]
    return 2.0 * math.atan2(sine, cosine) / sine * q[:3]


def angle(R: F64) -> float:
    """Angle [rad] of R (3, 3), in [0, pi]."""
    return float(np.linalg.norm(log(R)))


def left_jacobian(w: ArrayLike) -> F64:
    """J (3, 3) with `exp(w + dw) == exp(J @ dw) @ exp(w)` to first order."""
    x, y, z = _listed(w)
    theta = math.hypot(x, y, z)
    return _combined((x, y, z), _cos_ratio(theta), _cubic_ratio(theta))


def left_jacobian_inverse(w: ArrayLike) -> F64:
    """Inverse (3, 3) of `left_jacobian`, for angles below 2 pi."""
    x, y, z = _listed(w)
    return _combined((x, y, z), -0.5, _cotangent_ratio(math.hypot(x, y, z)))


def normalise(R: F64) -> F64:
    """Nearest proper rotation (3, 3) to R (3, 3) in the Frobenius norm."""
    U, _, Vt = np.linalg.svd(R)
    U[:, 2] *= np.sign(np.linalg.det(U @ Vt))
    return np.asarray(U @ Vt, np.float64)


def from_quaternion_xyzw(q: ArrayLike) -> F64:
    """Rotations (..., 3, 3) of quaternions (..., 4) in the order x y z w, of any length but 0."""
    q = np.asarray(q, np.float64)
    x, y, z, w = np.moveaxis(q / np.linalg.norm(q, axis=-1, keepdims=True), -1, 0)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)),
        (2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)),
        (2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)),
    )
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def to_quaternion_xyzw(R: F64) -> F64:
    """Quaternion (4,) x y z w of R (3, 3), of unit length, with w >= 0.

    It divides by the largest component, so that no angle loses digits (Shepperd 1978).
    """
    trace = R[0, 0] + R[1, 1] + R[2, 2]
    largest = int(np.argmax([R[0, 0], R[1, 1], R[2, 2], trace]))
    q = np.empty(4)
    if largest == 3:
        q[:3] = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]
        q[3] = 1.0 + trace
    else:
        i, j, k = largest, (largest + 1) % 3, (largest + 2) % 3
        q[i] = 1.0 + R[i, i] - R[j, j] - R[k, k]
        q[j] = R[i, j] + R[j, i]
        q[k] = R[i, k] + R[k, i]
        q[3] = R[k, j] - R[j, k]
    q /= np.linalg.norm(q)
    return -q if q[3] < 0.0 else q


def _listed(w: ArrayLike) -> list[float]:
    return list(np.asarray(w, np.float64).tolist())


def _combined(w: tuple[float, float, float], a: float, b: float) -> F64:
    """I + a W + b W^2 with W = hat(w); number by number, a fifth of the time of small matrices."""
    x, y, z = w
    bxy, bxz, byz = b * x * y, b * x * z, b * y * z
    return np.array(
        [
            [1.0 - b * (y * y + z * z), bxy - a * z, bxz + a * y],
            [bxy + a * z, 1.0 - b * (x * x + z * z), byz - a * x],
            [bxz - a * y, byz + a * x, 1.0 - b * (x * x + y * y)],
        ]
    )


def _sin_ratio(theta: float) -> float:
    """sin(theta) / theta."""
    return math.sin(theta) / theta if theta > 1e-150 else 1.0


def _cos_ratio(theta: float) -> float:
    """(1 - cos(theta)) / theta^2, through the half angle: nothing cancels."""
    half = _sin_ratio(0.5 * theta)
    return 0.5 * half * half


def _cubic_ratio(theta: float) -> float:
    """(theta - sin(theta)) / theta^3."""
    if theta > _SERIES_BELOW_RAD:
        return (theta - math.sin(theta)) / theta**3
    s = theta * theta
    return (1 - s / 20 * (1 - s / 42 * (1 - s / 72 * (1 - s / 110)))) / 6


def _cotangent_ratio(theta: float) -> float:
    """(1 - theta / 2 * cot(theta / 2)) / theta^2."""
    if theta > _SERIES_BELOW_RAD:
        return (1.0 - 0.5 * theta / math.tan(0.5 * theta)) / (theta * theta)
    s = theta * theta
    return (1 + s / 60 * (1 + s / 42 * (1 + s / 40 * (1 + s * 5 / 198)))) / 12
