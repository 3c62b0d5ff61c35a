# SPDX-License-Identifier: Apache-2.0
"""Lines in the window: their residuals in keyframes, with the lines themselves eliminated."""

import math

import numpy as np

from edge.geometry.kernels import solve_symmetric
from edge.kernel import kernel
from edge.lines.kernels_residual import crossed, measure, turned
from edge.lines.kernels_structure import frame_across
from edge.types import F64, I32, Pinhole

_OPEN = 1e-6  # information of a line in a direction that no view holds, in its units
_FAR_M2 = 1e6  # of a view from which a line cannot be measured


@kernel
def line_system(
    start: I32,
    frame: I32,
    T: F64,
    middle: F64,
    direction2: F64,
    length: F64,
    sigma: F64,
    point: F64,
    direction: F64,
    camera: Pinhole,
    unit: float,
    cauchy2: float,
    damping: float,
    H: F64,
    b: F64,
    H_lines: F64,
    b_lines: F64,
    H_frames: F64,
    m2: F64,
) -> float:
    """Add the lines' part to H, b of the frames; returns their robust cost.

    start      (n + 1,) int32    views of line i: start[i] to start[i + 1]
    frame      (v,)     int32    keyframe of the window that a view is of
    T          (v, 4, 4) float64 camera from odometry frame of each view
    middle, direction2, length, sigma    of the views' segments
    point, direction    (n, 3)   float64  of the lines, odometry frame
    unit       energy of one squared sigma
    H, b       (8 f, 8 f), (8 f,)  float64, in and out
    H_lines, b_lines    (n, 4, 4), (n, 4)  float64, out  information and gradient of each line
    H_frames   (v, 6, 4) float64, out  products of a view's pose with its line
    m2         (v,)      float64, out  squared distances [sigma^2], two freedoms each
    """
    e, J, basis = np.empty(2), np.empty((2, 6)), np.empty((2, 3))
    Jp, Jl = np.empty((2, 6)), np.empty((2, 4))
    A, column, solved = np.empty((4, 4)), np.empty(4), np.empty((4, 6))
    step = np.empty(4)
    cost = 0.0
    for i in range(point.shape[0]):
        frame_across(direction[i], basis)
        H_lines[i, :, :], b_lines[i, :] = 0.0, 0.0
        for j in range(start[i], start[i + 1]):
            H_frames[j, :, :] = 0.0
            m2[j] = _FAR_M2
            x, y, z = turned(T[j], point[i, 0], point[i, 1], point[i, 2])
            P = (x + T[j, 0, 3], y + T[j, 1, 3], z + T[j, 2, 3])
            D = turned(T[j], direction[i, 0], direction[i, 1], direction[i, 2])
            if not measure(middle[j], direction2[j], length[j], camera, P, D, e, J):
                continue
            variance = 0.5 * sigma[j] * sigma[j]
            m2[j] = (e[0] * e[0] + e[1] * e[1]) / variance
            cost += unit * cauchy2 * math.log1p(m2[j] / cauchy2)
            weight = unit / ((1.0 + m2[j] / cauchy2) * variance)
            for k in range(2):
                by_point = (J[k, 0], J[k, 1], J[k, 2])
                by_direction = (J[k, 3], J[k, 4], J[k, 5])
                # A twist (v, w) moves P by v + w x P and D by w x D.
                one, two = crossed(P, by_point), crossed(D, by_direction)
                for c in range(3):
                    Jp[k, c] = by_point[c]
                    Jp[k, 3 + c] = one[c] + two[c]
                for a in range(2):
                    B = turned(T[j], basis[a, 0], basis[a, 1], basis[a, 2])
                    Jl[k, a] = J[k, 0] * B[0] + J[k, 1] * B[1] + J[k, 2] * B[2]
                    Jl[k, 2 + a] = J[k, 3] * B[0] + J[k, 4] * B[1] + J[k, 5] * B[2]
            at = 8 * frame[j]
            for k in range(2):
                for r in range(4):
                    b_lines[i, r] += weight * Jl[k, r] * e[k]
                    for c in range(4):
                        H_lines[i, r, c] += weight * Jl[k, r] * Jl[k, c]
                for r in range(6):
                    b[at + r] += weight * Jp[k, r] * e[k]
                    for c in range(6):
                        H[at + r, at + c] += weight * Jp[k, r] * Jp[k, c]
                    for c in range(4):
                        H_frames[j, r, c] += weight * Jp[k, r] * Jl[k, c]
        for j in range(start[i], start[i + 1]):
            for r in range(6):
                _line_matrix(H_lines[i], damping, unit, A)
                for c in range(4):
                    column[c] = H_frames[j, r, c]
                if not solve_symmetric(A, column, step):
                    step[:] = 0.0
                for c in range(4):
                    solved[c, r] = step[c]
            for r in range(6):
                for c in range(4):
                    b[8 * frame[j] + r] -= solved[c, r] * b_lines[i, c]
            for other in range(start[i], start[i + 1]):
                for r in range(6):
                    for q in range(6):
                        total = 0.0
                        for c in range(4):
                            total += solved[c, r] * H_frames[other, q, c]
                        H[8 * frame[j] + r, 8 * frame[other] + q] -= total
    return cost


@kernel
def _line_matrix(H_line: F64, damping: float, unit: float, A: F64) -> None:
    """Set A (4, 4) to a line's information, damped and held where nothing else holds it."""
    for r in range(4):
        for c in range(4):
            A[r, c] = H_line[r, c]
        A[r, r] = H_line[r, r] * (1.0 + damping) + unit * _OPEN


@kernel
def move_lines(
    start: I32,
    frame: I32,
    H_lines: F64,
    b_lines: F64,
    H_frames: F64,
    dx: F64,
    unit: float,
    damping: float,
    point: F64,
    direction: F64,
) -> None:
    """Move lines (n, 3), (n, 3) as the frames' step dx (8 f,) and their own residuals ask."""
    basis, A, right, step = np.empty((2, 3)), np.empty((4, 4)), np.empty(4), np.empty(4)
    for i in range(point.shape[0]):
        for c in range(4):
            right[c] = -b_lines[i, c]
        for j in range(start[i], start[i + 1]):
            for r in range(6):
                for c in range(4):
                    right[c] -= H_frames[j, r, c] * dx[8 * frame[j] + r]
        _line_matrix(H_lines[i], damping, unit, A)
        if not solve_symmetric(A, right, step):
            continue
        frame_across(direction[i], basis)
        norm = 0.0
        for k in range(3):
            point[i, k] += step[0] * basis[0, k] + step[1] * basis[1, k]
            direction[i, k] += step[2] * basis[0, k] + step[3] * basis[1, k]
            norm += direction[i, k] ** 2
        norm = math.sqrt(norm)
        for k in range(3):
            direction[i, k] /= norm
