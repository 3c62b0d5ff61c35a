# SPDX-License-Identifier: Apache-2.0
"""Line-Based Orthogonal Iteration: a camera pose from lines, from any start.

Orthogonal iteration (Lu, Hager, Mjolsness, "Fast and globally convergent pose estimation from
video images", PAMI 22(6), 2000) with planes in place of rays, as used for line segments by Hirose
and Saito (2011). A seen line and the camera's centre span a plane with unit normal n; a line in
space with point p and direction d is seen right where n . (R p + t) = 0 and n . R d = 0. The cost
is the sum of w (n . (R p + t))^2 + v (n . R d)^2, free of ends. Each round projects R p + t and
R d onto the planes, K = 1 - n n^T, and takes the rigid motion that brings the points p and the
directions d nearest to those projections in closed form (Horn 1987). A projection is the nearest
point of its plane, so the sum of squares to last round's projections bounds the cost from above
and touches it at the present pose: no round can raise it, and where it rests its gradient is zero.
"""

import math

import numpy as np

from edge.geometry.kernels import solve_symmetric
from edge.kernel import kernel
from edge.types import F64

_SWEEPS = 12  # of Jacobi rotations; 4x4 settles in five or six
# The translation that the planes leave open stays where it was.
_HOLD = 1e-9


@kernel
def rotation_onto(M: F64, R: F64) -> None:
    """Set R to the rotation with the largest trace of R^T M (Horn 1987, by a unit quaternion).

    M  (3, 3)  float64  sum of target x source^T
    R  (3, 3)  float64, out
    """
    A, V = np.empty((4, 4)), np.zeros((4, 4))
    A[0, 0] = M[0, 0] + M[1, 1] + M[2, 2]
    A[1, 1] = M[0, 0] - M[1, 1] - M[2, 2]
    A[2, 2] = M[1, 1] - M[0, 0] - M[2, 2]
    A[3, 3] = M[2, 2] - M[0, 0] - M[1, 1]
    A[0, 1] = A[1, 0] = M[2, 1] - M[1, 2]
    A[0, 2] = A[2, 0] = M[0, 2] - M[2, 0]
    A[0, 3] = A[3, 0] = M[1, 0] - M[0, 1]
    A[1, 2] = A[2, 1] = M[0, 1] + M[1, 0]
    A[1, 3] = A[3, 1] = M[0, 2] + M[2, 0]
    A[2, 3] = A[3, 2] = M[1, 2] + M[2, 1]
    for i in range(4):
        V[i, i] = 1.0
    for _ in range(_SWEEPS):
        off, size = 0.0, 0.0
        for i in range(4):
            size += A[i, i] * A[i, i]
            for j in range(i):
                off += A[i, j] * A[i, j]
        if off <= 1e-30 * size:
            break
        for i in range(3):
            for j in range(i + 1, 4):
                if A[i, j] == 0.0:
                    continue
                theta = (A[j, j] - A[i, i]) / (2.0 * A[i, j])
                tangent = 1.0 / (abs(theta) + math.sqrt(theta * theta + 1.0))
                if theta < 0.0:
                    tangent = -tangent
                c = 1.0 / math.sqrt(tangent * tangent + 1.0)
                s = tangent * c
                for k in range(4):
                    x, y = A[k, i], A[k, j]
                    A[k, i], A[k, j] = c * x - s * y, s * x + c * y
                for k in range(4):
                    x, y = A[i, k], A[j, k]
                    A[i, k], A[j, k] = c * x - s * y, s * x + c * y
                for k in range(4):
                    x, y = V[k, i], V[k, j]
                    V[k, i], V[k, j] = c * x - s * y, s * x + c * y
    best = 0
    for i in range(1, 4):
        if A[i, i] > A[best, best]:
            best = i
    w, x, y, z = V[0, best], V[1, best], V[2, best], V[3, best]
    R[0, 0], R[0, 1], R[0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)
    R[1, 0], R[1, 1], R[1, 2] = 2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)
    R[2, 0], R[2, 1], R[2, 2] = 2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)


@kernel
def best_translation(normals: F64, points: F64, weights: F64, R: F64, t: F64) -> None:
    """Move t to the least sum of w (n . (R p + t))^2; what the planes leave open stays."""
    S, b, step = np.zeros((3, 3)), np.zeros(3), np.empty(3)
    for i in range(normals.shape[0]):
        n = (normals[i, 0], normals[i, 1], normals[i, 2])
        e = 0.0
        for r in range(3):
            y = t[r]
            for c in range(3):
                y += R[r, c] * points[i, c]
            e += n[r] * y
        for r in range(3):
            b[r] -= weights[i] * n[r] * e
            for c in range(3):
                S[r, c] += weights[i] * n[r] * n[c]
    hold = _HOLD * (S[0, 0] + S[1, 1] + S[2, 2]) + 1e-300
    for r in range(3):
        S[r, r] += hold
    if solve_symmetric(S, b, step):
        for r in range(3):
            t[r] += step[r]


@kernel
def iterate(
    normals: F64,
    points: F64,
    directions: F64,
    point_weights: F64,
    direction_weights: F64,
    max_rounds: int,
    done: float,
    R: F64,
    t: F64,
) -> tuple[float, int]:
    """Move R, t to a critical point of the cost; return the last cost and the rounds it took.

    normals            (n, 3)  float64  of the planes seen, of unit length, camera frame
    points             (n, 3)  float64  on the lines in space
    directions         (n, 3)  float64  of the lines, of unit length
    point_weights      (n,)    float64
    direction_weights  (n,)    float64
    done               share of the cost below which a round's gain ends it
    R, t               (3, 3), (3,)  float64, in and out
    """
    n = normals.shape[0]
    M, q, v = np.empty((3, 3)), np.empty(3), np.empty(3)
    sum_q, sum_p = np.empty(3), np.empty(3)
    last = math.inf
    for count in range(max_rounds + 1):
        best_translation(normals, points, point_weights, R, t)
        M[:, :], sum_q[:], sum_p[:] = 0.0, 0.0, 0.0
        cost, total = 0.0, 0.0
        for i in range(n):
            w, u = point_weights[i], direction_weights[i]
            e, f = 0.0, 0.0
            for r in range(3):
                q[r] = t[r]
                v[r] = 0.0
                for c in range(3):
                    q[r] += R[r, c] * points[i, c]
                    v[r] += R[r, c] * directions[i, c]
                e += normals[i, r] * q[r]
                f += normals[i, r] * v[r]
            cost += w * e * e + u * f * f
            total += w
            for r in range(3):
                q[r] -= e * normals[i, r]
                v[r] -= f * normals[i, r]
                sum_q[r] += w * q[r]
                sum_p[r] += w * points[i, r]
            for r in range(3):
                for c in range(3):
                    M[r, c] += w * q[r] * points[i, c] + u * v[r] * directions[i, c]
        if last - cost <= done * cost or count == max_rounds:
            return cost, count
        last = cost
        for r in range(3):
            for c in range(3):
                M[r, c] -= sum_q[r] * sum_p[c] / max(total, 1e-300)
        rotation_onto(M, R)
    return last, max_rounds
