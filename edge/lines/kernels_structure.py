# SPDX-License-Identifier: Apache-2.0
"""Lines in space from the segments of several views."""

import math

import numpy as np

from edge.geometry.kernels import solve_symmetric
from edge.kernel import kernel
from edge.lines.kernels_residual import crossed, measure, turned
from edge.types import F64, I32, Pinhole

_FIRST_DAMPING = 1e-3
_DONE_GAIN = 1e-6  # promised decrease of the cost, in squared sigmas
_OPEN_VARIANCE = 1e6  # of what the views do not say


@kernel
def frame_across(direction: F64, basis: F64) -> None:
    """Set basis (2, 3) to two unit vectors across a direction (3,), as `line.across` does."""
    least = 0
    for k in range(1, 3):
        if abs(direction[k]) < abs(direction[least]):
            least = k
    D = (direction[0], direction[1], direction[2])
    axis = (1.0 if least == 0 else 0.0, 1.0 if least == 1 else 0.0, 1.0 if least == 2 else 0.0)
    first = crossed(D, axis)
    norm = math.sqrt(first[0] ** 2 + first[1] ** 2 + first[2] ** 2)
    first = (first[0] / norm, first[1] / norm, first[2] / norm)
    second = crossed(D, first)
    for k in range(3):
        basis[0, k], basis[1, k] = first[k], second[k]


@kernel
def _system(
    low: int,
    high: int,
    middle: F64,
    direction2: F64,
    length: F64,
    sigma: F64,
    T: F64,
    camera: Pinhole,
    p: F64,
    d: F64,
    basis: F64,
    cauchy2: float,
    H: F64,
    b: F64,
    m2: F64,
) -> float:
    """Overwrite H (4, 4), b (4,) with one line's Gauss-Newton system; return the robust cost."""
    H[:, :], b[:] = 0.0, 0.0
    e, J = np.empty(2), np.empty((2, 6))
    G = np.empty(4)
    cost = 0.0
    for i in range(low, high):
        x, y, z = turned(T[i], p[0], p[1], p[2])
        P = (x + T[i, 0, 3], y + T[i, 1, 3], z + T[i, 2, 3])
        D = turned(T[i], d[0], d[1], d[2])
        if not measure(middle[i], direction2[i], length[i], camera, P, D, e, J):
            m2[i] = math.inf
            continue
        variance = 0.5 * sigma[i] * sigma[i]
        m2[i] = (e[0] * e[0] + e[1] * e[1]) / variance
        cost += cauchy2 * math.log1p(m2[i] / cauchy2)
        weight = 1.0 / ((1.0 + m2[i] / cauchy2) * variance)
        for k in range(2):
            for a in range(2):
                B = turned(T[i], basis[a, 0], basis[a, 1], basis[a, 2])
                G[a] = J[k, 0] * B[0] + J[k, 1] * B[1] + J[k, 2] * B[2]
                G[2 + a] = J[k, 3] * B[0] + J[k, 4] * B[1] + J[k, 5] * B[2]
            for r in range(4):
                b[r] -= weight * G[r] * e[k]
                for c in range(4):
                    H[r, c] += weight * G[r] * G[c]
    return cost


@kernel
def _step(p: F64, d: F64, basis: F64, step: F64, p_new: F64, d_new: F64) -> None:
    """Shift p and tilt d along the basis; d stays of unit length."""
    norm = 0.0
    for k in range(3):
        p_new[k] = p[k] + step[0] * basis[0, k] + step[1] * basis[1, k]
        d_new[k] = d[k] + step[2] * basis[0, k] + step[3] * basis[1, k]
        norm += d_new[k] * d_new[k]
    norm = math.sqrt(norm)
    for k in range(3):
        d_new[k] /= norm


@kernel
def _invert(H: F64, A: F64, covariance: F64) -> None:
    """Set covariance (4, 4) to the inverse of H; what H leaves open is held a little."""
    unit, column = np.empty(4), np.empty(4)
    for c in range(4):
        for r in range(4):
            unit[r] = 1.0 if r == c else 0.0
            for k in range(4):
                A[r, k] = H[r, k]
            A[r, r] += 1.0 / _OPEN_VARIANCE
        solve_symmetric(A, unit, column)
        for r in range(4):
            covariance[r, c] = column[r]


@kernel
def refine(
    start: I32,
    middle: F64,
    direction2: F64,
    length: F64,
    sigma: F64,
    T: F64,
    camera: Pinhole,
    cauchy2: float,
    max_steps: int,
    point: F64,
    direction: F64,
    covariance: F64,
    m2: F64,
) -> None:
    """Move lines to the least robust cost of their views (Levenberg-Marquardt), each alone.

    start              (n + 1,)  int32    views of line i: start[i] to start[i + 1]
    middle, direction2, length, sigma     of all views' segments, (m, 2), (m, 2), (m,), (m,)
    T                  (m, 4, 4) float64  camera from lines of each view
    point, direction   (n, 3)    float64, in and out
    covariance         (n, 4, 4) float64, out
    m2                 (m,)      float64, out  squared distances of views, two freedoms each
    """
    H, A, H_new, basis = np.empty((4, 4)), np.empty((4, 4)), np.empty((4, 4)), np.empty((2, 3))
    b, b_new, step, p_new, d_new = np.empty(4), np.empty(4), np.empty(4), np.empty(3), np.empty(3)
    basis_new, m2_new = np.empty((2, 3)), np.empty(m2.shape[0])
    for i in range(point.shape[0]):
        low, high = start[i], start[i + 1]
        p, d = point[i], direction[i]
        frame_across(d, basis)
        damping = _FIRST_DAMPING
        cost = _system(
            low, high, middle, direction2, length, sigma, T, camera, p, d, basis,
            cauchy2, H, b, m2,
        )  # fmt: skip
        for _ in range(max_steps):
            for r in range(4):
                for c in range(4):
                    A[r, c] = H[r, c]
                A[r, r] = H[r, r] * (1.0 + damping) + 1.0 / _OPEN_VARIANCE
            if not solve_symmetric(A, b, step):
                break
            _step(p, d, basis, step, p_new, d_new)
            frame_across(d_new, basis_new)
            new_cost = _system(
                low, high, middle, direction2, length, sigma, T, camera, p_new, d_new, basis_new,
                cauchy2, H_new, b_new, m2_new,
            )  # fmt: skip
            if not new_cost <= cost:
                damping *= 10.0
                if damping > 1e6:
                    break
                continue
            promised = 0.0
            for r in range(4):
                promised += b[r] * step[r]
            cost = new_cost
            p[:], d[:], basis[:, :], H[:, :], b[:] = p_new, d_new, basis_new, H_new, b_new
            for k in range(low, high):
                m2[k] = m2_new[k]
            damping = max(0.1 * damping, 1e-9)
            if promised < _DONE_GAIN:
                break
        _invert(H, A, covariance[i])
