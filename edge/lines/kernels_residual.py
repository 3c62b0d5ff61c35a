# SPDX-License-Identifier: Apache-2.0
"""How far seen segments are from projected lines, in pixels, and the pose at the least of it.

Two residuals a segment: how far its middle is from the projected line, and the angle between the
two, times half the segment's length. If both ends err by the same sigma across, independently, the
two are independent and their variance is sigma^2 / 2 each. Where the segment ends along the line
moves neither but by what the line itself is turned.
"""

import math

import numpy as np

from edge.geometry.kernels import exp_times, solve_symmetric
from edge.kernel import inline_kernel, kernel
from edge.types import F64, Pinhole

_FIRST_DAMPING = 1e-4
_DONE_GAIN = 1e-5  # promised decrease of the cost, in squared sigmas, below which to stop
_MIN_NORMAL_PX = 1e-12


@inline_kernel
def turned(R, x, y, z):  # type: ignore[no-untyped-def]
    """R @ (x, y, z)."""
    return (
        R[0, 0] * x + R[0, 1] * y + R[0, 2] * z,
        R[1, 0] * x + R[1, 1] * y + R[1, 2] * z,
        R[2, 0] * x + R[2, 1] * y + R[2, 2] * z,
    )


@inline_kernel
def crossed(a, b):  # type: ignore[no-untyped-def]
    """Vector product of two triples."""
    return (
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    )


@kernel
def measure(
    middle: F64,
    direction2: F64,
    length: float,
    camera: Pinhole,
    P: tuple[float, float, float],
    D: tuple[float, float, float],
    e: F64,
    J: F64,
) -> bool:
    """Set both residuals [px] and their derivatives by moves of the line; False if it has none.

    middle, direction2  (2,)  float64  of the segment
    P, D   a point of the line and its direction, camera frame
    e      (2,)    float64, out
    J      (2, 6)  float64, out  by a shift of P, then by a change of D
    """
    N = crossed(P, D)
    lu, lv = N[0] / camera.fx, N[1] / camera.fy
    lw = N[2] - camera.cx * lu - camera.cy * lv
    norm = math.sqrt(lu * lu + lv * lv)
    if not norm > _MIN_NORMAL_PX:
        return False
    # Normals look to the same side, so that signs say which way the line is off.
    if -direction2[1] * lu + direction2[0] * lv < 0.0:
        norm = -norm
    gu, gv, gw = lu / norm, lv / norm, lw / norm
    e[0] = gu * middle[0] + gv * middle[1] + gw
    half = 0.5 * length
    sine = gu * direction2[0] + gv * direction2[1]
    e[1] = half * sine
    for k in range(2):
        if k == 0:
            du, dv, dw = middle[0] - e[0] * gu, middle[1] - e[0] * gv, 1.0
        else:
            du, dv, dw = half * (direction2[0] - sine * gu), half * (direction2[1] - sine * gv), 0.0
        h = (
            (du - camera.cx * dw) / (camera.fx * norm),
            (dv - camera.cy * dw) / (camera.fy * norm),
            dw / norm,
        )
        by_point, by_direction = crossed(D, h), crossed(h, P)
        for c in range(3):
            J[k, c] = by_point[c]
            J[k, 3 + c] = by_direction[c]
    return True


@inline_kernel
def whiten(variance, S, e):  # type: ignore[no-untyped-def]
    """Cholesky factors of variance + S and the residuals in their units; S (uu, uv, vv)."""
    l00 = math.sqrt(variance + S[0])
    l10 = S[1] / l00
    l11 = math.sqrt(max(variance + S[2] - l10 * l10, 1e-12))
    e0 = e[0] / l00
    return l00, l10, l11, e0, (e[1] - l10 * e0) / l11


@kernel
def normal_equations(
    middle: F64,
    direction2: F64,
    length: F64,
    sigma: F64,
    point: F64,
    direction: F64,
    basis: F64,
    covariance: F64,
    use: F64,
    camera: Pinhole,
    R: F64,
    t: F64,
    cauchy2: float,
    H: F64,
    b: F64,
    m2: F64,
) -> float:
    """Overwrite H, b with the weighted Gauss-Newton system; return the robust cost.

    middle, direction2, length, sigma   of the segments, (n, 2), (n, 2), (n,), (n,)  float64
    point, direction, basis, covariance of the lines, (n, 3), (n, 3), (n, 2, 3), (n, 4, 4)
    use      (n,)  float64  weight from outside, 0 to leave one out
    cauchy2  squared scale of a Cauchy kernel, in squared Mahalanobis distance
    H, b     (6, 6), (6,)  float64, out  of steps exp(xi) @ (R, t)
    m2       (n,)  float64, out  squared Mahalanobis distances, two degrees of freedom each
    """
    H[:, :], b[:] = 0.0, 0.0
    e, J, G, S = np.empty(2), np.empty((2, 6)), np.empty((2, 4)), np.empty(3)
    W = np.empty((2, 6))
    cost = 0.0
    for i in range(middle.shape[0]):
        x, y, z = turned(R, point[i, 0], point[i, 1], point[i, 2])
        P = (x + t[0], y + t[1], z + t[2])
        D = turned(R, direction[i, 0], direction[i, 1], direction[i, 2])
        if not measure(middle[i], direction2[i], length[i], camera, P, D, e, J):
            m2[i] = math.inf
            continue
        for k in range(2):
            for a in range(2):
                B = turned(R, basis[i, a, 0], basis[i, a, 1], basis[i, a, 2])
                G[k, a] = J[k, 0] * B[0] + J[k, 1] * B[1] + J[k, 2] * B[2]
                G[k, 2 + a] = J[k, 3] * B[0] + J[k, 4] * B[1] + J[k, 5] * B[2]
        S[:] = 0.0
        for r in range(4):
            for c in range(4):
                S[0] += G[0, r] * covariance[i, r, c] * G[0, c]
                S[1] += G[0, r] * covariance[i, r, c] * G[1, c]
                S[2] += G[1, r] * covariance[i, r, c] * G[1, c]
        l00, l10, l11, e0, e1 = whiten(0.5 * sigma[i] * sigma[i], S, e)
        m2[i] = e0 * e0 + e1 * e1
        cost += use[i] * cauchy2 * math.log1p(m2[i] / cauchy2)
        weight = use[i] / (1.0 + m2[i] / cauchy2)
        for k in range(2):
            by_P, by_D = (J[k, 0], J[k, 1], J[k, 2]), (J[k, 3], J[k, 4], J[k, 5])
            from_P, from_D = crossed(P, by_P), crossed(D, by_D)
            for c in range(3):
                W[k, c] = by_P[c]
                W[k, 3 + c] = from_P[c] + from_D[c]
        for c in range(6):
            W[0, c] /= l00
            W[1, c] = (W[1, c] - l10 * W[0, c]) / l11
        for r in range(6):
            b[r] -= weight * (W[0, r] * e0 + W[1, r] * e1)
            for c in range(6):
                H[r, c] += weight * (W[0, r] * W[0, c] + W[1, r] * W[1, c])
    return cost


@kernel
def refine(
    middle: F64,
    direction2: F64,
    length: F64,
    sigma: F64,
    point: F64,
    direction: F64,
    basis: F64,
    covariance: F64,
    use: F64,
    camera: Pinhole,
    R: F64,
    t: F64,
    cauchy2: float,
    max_steps: int,
    H: F64,
    m2: F64,
) -> float:
    """Move R, t to the least robust cost near by (Levenberg-Marquardt); return the cost.

    R, t  (3, 3), (3,)  float64, in and out
    H     (6, 6)  float64, out  normal equations at the end
    m2    (n,)    float64, out  squared distances at the end
    """
    A, H_new, R_new = np.empty((6, 6)), np.empty((6, 6)), np.empty((3, 3))
    b, b_new, step, t_new = np.empty(6), np.empty(6), np.empty(6), np.empty(3)
    m2_new = np.empty(m2.shape[0])
    damping = _FIRST_DAMPING
    cost = normal_equations(
        middle, direction2, length, sigma, point, direction, basis, covariance, use,
        camera, R, t, cauchy2, H, b, m2,
    )  # fmt: skip
    for _ in range(max_steps):
        trace = 0.0
        for r in range(6):
            trace += H[r, r]
        for r in range(6):
            for c in range(6):
                A[r, c] = H[r, c]
            # Directions that the lines leave open have no diagonal of their own.
            A[r, r] = H[r, r] * (1.0 + damping) + 1e-12 * trace + 1e-300
        if not solve_symmetric(A, b, step):
            damping = max(10.0 * damping, 1e-6)
            if damping > 1e6:
                break
            continue
        exp_times(step, R, t, R_new, t_new)
        new_cost = normal_equations(
            middle, direction2, length, sigma, point, direction, basis, covariance, use,
            camera, R_new, t_new, cauchy2, H_new, b_new, m2_new,
        )  # fmt: skip
        if not new_cost <= cost:
            damping *= 10.0
            if damping > 1e6:
                break
            continue
        promised = 0.0
        for r in range(6):
            promised += b[r] * step[r]
        cost = new_cost
        R[:, :], t[:], H[:, :], b[:], m2[:] = R_new, t_new, H_new, b_new, m2_new
        damping = max(0.1 * damping, 1e-9)
        if promised < _DONE_GAIN:
            break
    return cost
