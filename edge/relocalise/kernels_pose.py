# SPDX-License-Identifier: Apache-2.0
"""Poses from 2D-3D matches: how far off a match is, and the best pose near by.

A match is a pixel (ideal pinhole), a map point with its covariance, and the sigma of the pixel.
What counts is the residual's Mahalanobis distance: a point that was seen at little parallax is
uncertain along its old viewing rays, and tells little to a camera that looks across them.
"""

import math

import numpy as np

from edge.geometry.kernels import solve_symmetric
from edge.kernel import inline_kernel, kernel
from edge.types import F64, Pinhole

MIN_DEPTH = 1e-6
_FIRST_DAMPING = 1e-4
# Promised decrease of the cost, in squared sigmas, below which to stop: a tenth of a sigma, of
# noise alone. What matches err together is more.
_DONE_GAIN = 1e-2
_BEHIND_M2 = 1e6  # squared distance of a match behind the camera
_WIDEST = 1e9  # a kernel so much wider than a distance makes nothing robust
_CERTAIN = 30.0  # log odds, by which the other side tells nothing


@inline_kernel
def to_camera(R, p, x, y, z):  # type: ignore[no-untyped-def]
    """Camera coordinates of a map point: R^T (x - p)."""
    x, y, z = x - p[0], y - p[1], z - p[2]
    return (
        R[0, 0] * x + R[1, 0] * y + R[2, 0] * z,
        R[0, 1] * x + R[1, 1] * y + R[2, 1] * z,
        R[0, 2] * x + R[1, 2] * y + R[2, 2] * z,
    )


@inline_kernel
def pixel_rows(camera, R, x, y, z):  # type: ignore[no-untyped-def]
    """Derivatives (2 rows of 3) of the pixel by the map point, at camera coordinates x y z."""
    iz = 1.0 / z
    au, bu = camera.fx * iz, -camera.fx * x * iz * iz
    av, bv = camera.fy * iz, -camera.fy * y * iz * iz
    return (
        au * R[0, 0] + bu * R[0, 2],
        au * R[1, 0] + bu * R[1, 2],
        au * R[2, 0] + bu * R[2, 2],
        av * R[0, 1] + bv * R[0, 2],
        av * R[1, 1] + bv * R[1, 2],
        av * R[2, 1] + bv * R[2, 2],
    )


@inline_kernel
def projected_covariance(C, i, u0, u1, u2, v0, v1, v2):  # type: ignore[no-untyped-def]
    """Covariance (uu, uv, vv) [px^2] of point i, seen through the rows of `pixel_rows`."""
    cu0 = C[i, 0] * u0 + C[i, 1] * u1 + C[i, 2] * u2
    cu1 = C[i, 1] * u0 + C[i, 3] * u1 + C[i, 4] * u2
    cu2 = C[i, 2] * u0 + C[i, 4] * u1 + C[i, 5] * u2
    cv0 = C[i, 0] * v0 + C[i, 1] * v1 + C[i, 2] * v2
    cv1 = C[i, 1] * v0 + C[i, 3] * v1 + C[i, 4] * v2
    cv2 = C[i, 2] * v0 + C[i, 4] * v1 + C[i, 5] * v2
    return (
        u0 * cu0 + u1 * cu1 + u2 * cu2,
        v0 * cu0 + v1 * cu1 + v2 * cu2,
        v0 * cv0 + v1 * cv1 + v2 * cv2,
    )


@kernel
def mahalanobis(
    pixels: F64,
    xyz: F64,
    C: F64,
    variance: F64,
    camera: Pinhole,
    R: F64,
    p: F64,
    m2: F64,
    pixel_variance: F64,
) -> None:
    """Write each match's squared Mahalanobis distance and the mean variance of its residual.

    m2, pixel_variance  (n,) float64, out; infinite for a point behind the camera
    """
    for i in range(pixels.shape[0]):
        x, y, z = to_camera(R, p, xyz[i, 0], xyz[i, 1], xyz[i, 2])
        if z < MIN_DEPTH:
            m2[i], pixel_variance[i] = np.inf, np.inf
            continue
        du = pixels[i, 0] - camera.fx * x / z - camera.cx
        dv = pixels[i, 1] - camera.fy * y / z - camera.cy
        u0, u1, u2, v0, v1, v2 = pixel_rows(camera, R, x, y, z)
        suu, suv, svv = projected_covariance(C, i, u0, u1, u2, v0, v1, v2)
        suu, svv = suu + variance[i], svv + variance[i]
        determinant = suu * svv - suv * suv
        m2[i] = (svv * du * du - 2.0 * suv * du * dv + suu * dv * dv) / determinant
        pixel_variance[i] = 0.5 * (suu + svv)


@inline_kernel
def robust_cost(m2, cauchy2, gate):  # type: ignore[no-untyped-def]
    """Cost and weight of a squared Mahalanobis distance: its derivative by that distance.

    -2 ln(exp(-c / 2) + exp(-gate / 2)), c = cauchy2 * ln(1 + m2 / cauchy2): never beyond the gate,
    or matches that tell nothing would decide by their sheer size which step is taken. Logarithms
    are most of what a match costs, and are left out where they say nothing.
    """
    cost, weight = m2, 1.0
    if cauchy2 < _WIDEST * m2:
        cost = cauchy2 * math.log1p(m2 / cauchy2)
        weight = 1.0 / (1.0 + m2 / cauchy2)
    apart = 0.5 * (cost - gate)
    if apart > _CERTAIN:
        return gate, 0.0
    if apart > -_CERTAIN:
        odds = math.exp(-abs(apart))
        cost = min(cost, gate) - 2.0 * math.log1p(odds)
        weight *= (odds if apart > 0.0 else 1.0) / (1.0 + odds)
    return cost, weight


@kernel
def normal_equations(
    pixels: F64,
    xyz: F64,
    C: F64,
    variance: F64,
    use: F64,
    camera: Pinhole,
    R: F64,
    p: F64,
    cauchy2: float,
    gate: float,
    H: F64,
    b: F64,
) -> float:
    """Overwrite H, b with the weighted Gauss-Newton system and return the robust cost.

    Steps are those of position and rotation in map axes: p + v, exp(w) R.

    use      (n,)    float64  weight of each match from outside, 0 to leave it out
    cauchy2  squared scale of a Cauchy kernel, in squared Mahalanobis distance
    gate     of another: beyond this squared distance a match tells nothing, however far it is,
             as in a mixture of a normal density with an even one. Infinite for none
    H, b     (6, 6), (6,)  float64, out; H is full
    """
    for r in range(6):
        b[r] = 0.0
        for c in range(6):
            H[r, c] = 0.0
    cost = 0.0
    for i in range(pixels.shape[0]):
        if use[i] == 0.0:
            continue
        x, y, z = to_camera(R, p, xyz[i, 0], xyz[i, 1], xyz[i, 2])
        if z < MIN_DEPTH:
            cost += use[i] * robust_cost(_BEHIND_M2, cauchy2, gate)[0]
            continue
        du = pixels[i, 0] - camera.fx * x / z - camera.cx
        dv = pixels[i, 1] - camera.fy * y / z - camera.cy
        u0, u1, u2, v0, v1, v2 = pixel_rows(camera, R, x, y, z)
        suu, suv, svv = projected_covariance(C, i, u0, u1, u2, v0, v1, v2)
        suu, svv = suu + variance[i], svv + variance[i]
        determinant = suu * svv - suv * suv
        iuu, iuv, ivv = svv / determinant, -suv / determinant, suu / determinant
        m2 = iuu * du * du + 2.0 * iuv * du * dv + ivv * dv * dv
        rho, weight = robust_cost(m2, cauchy2, gate)
        cost += use[i] * rho
        weight *= use[i]
        if weight == 0.0:
            continue
        iuu, iuv, ivv = weight * iuu, weight * iuv, weight * ivv
        # The pixel moves with the point's motion against the camera: -v - w x (x - p).
        dx, dy, dz = xyz[i, 0] - p[0], xyz[i, 1] - p[1], xyz[i, 2] - p[2]
        J0 = (-u0, -u1, -u2, u1 * dz - u2 * dy, u2 * dx - u0 * dz, u0 * dy - u1 * dx)
        J1 = (-v0, -v1, -v2, v1 * dz - v2 * dy, v2 * dx - v0 * dz, v0 * dy - v1 * dx)
        e0, e1 = iuu * du + iuv * dv, iuv * du + ivv * dv
        for r in range(6):
            b[r] += J0[r] * e0 + J1[r] * e1
            k0, k1 = iuu * J0[r] + iuv * J1[r], iuv * J0[r] + ivv * J1[r]
            for c in range(r + 1):
                H[r, c] += k0 * J0[c] + k1 * J1[c]
    for r in range(6):
        for c in range(r):
            H[c, r] = H[r, c]
    return cost


@inline_kernel
def step_pose(R, p, step, R_out, p_out):  # type: ignore[no-untyped-def]
    """R_out = exp(w) R, p_out = p + v, of a step (6,) v, w."""
    wx, wy, wz = step[3], step[4], step[5]
    t2 = wx * wx + wy * wy + wz * wz
    t = math.sqrt(t2)
    if t < 1e-8:
        a, c = 1.0, 0.5
    else:
        a, c = math.sin(t) / t, (1.0 - math.cos(t)) / t2
    e00, e11, e22 = (
        1.0 - c * (wy * wy + wz * wz),
        1.0 - c * (wx * wx + wz * wz),
        1.0 - c * (wx * wx + wy * wy),
    )
    e01, e10 = c * wx * wy - a * wz, c * wx * wy + a * wz
    e02, e20 = c * wx * wz + a * wy, c * wx * wz - a * wy
    e12, e21 = c * wy * wz - a * wx, c * wy * wz + a * wx
    for j in range(3):
        R_out[0, j] = e00 * R[0, j] + e01 * R[1, j] + e02 * R[2, j]
        R_out[1, j] = e10 * R[0, j] + e11 * R[1, j] + e12 * R[2, j]
        R_out[2, j] = e20 * R[0, j] + e21 * R[1, j] + e22 * R[2, j]
        p_out[j] = p[j] + step[j]


@kernel
def refine(
    pixels: F64,
    xyz: F64,
    C: F64,
    variance: F64,
    use: F64,
    camera: Pinhole,
    R: F64,
    p: F64,
    cauchy2: float,
    gate: float,
    max_steps: int,
    H: F64,
) -> float:
    """Move R, p to the least robust cost near by (Levenberg-Marquardt); return the cost.

    The matches' weights follow the pose, since projected covariances do.

    R, p  (3, 3), (3,)  float64, in and out
    H     (6, 6)        float64, out: normal equations at the end
    """
    A, H_new = np.empty((6, 6)), np.empty((6, 6))
    b, b_new, step = np.empty(6), np.empty(6), np.empty(6)
    R_new, p_new = np.empty((3, 3)), np.empty(3)
    damping = _FIRST_DAMPING
    cost = normal_equations(pixels, xyz, C, variance, use, camera, R, p, cauchy2, gate, H, b)
    for _ in range(max_steps):
        for r in range(6):
            for c in range(6):
                A[r, c] = H[r, c]
            A[r, r] = H[r, r] * (1.0 + damping)
        if not solve_symmetric(A, b, step):
            damping = max(10.0 * damping, 1e-6)
            if damping > 1e6:
                break
            continue
        # b is J^T r with r = seen - predicted and J that of the prediction: the step is +.
        step_pose(R, p, step, R_new, p_new)
        new_cost = normal_equations(
            pixels, xyz, C, variance, use, camera, R_new, p_new, cauchy2, gate, H_new, b_new
        )
        promised = 0.0
        for r in range(6):
            promised += b[r] * step[r]
        if new_cost > cost:
            damping *= 10.0
            # What promises nothing and gives less: the cost is only as exact as its numbers.
            if damping > 1e6 or promised < _DONE_GAIN:
                break
            continue
        for r in range(6):
            b[r] = b_new[r]
            for c in range(6):
                H[r, c] = H_new[r, c]
        for r in range(3):
            p[r] = p_new[r]
            for c in range(3):
                R[r, c] = R_new[r, c]
        cost = new_cost
        damping = max(0.1 * damping, 1e-9)
        if promised < _DONE_GAIN:
            break
    return cost
