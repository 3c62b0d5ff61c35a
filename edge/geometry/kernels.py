# SPDX-License-Identifier: Apache-2.0
"""Rigid-body steps and small linear systems for use inside other kernels."""

import math

import numpy as np

from edge.kernel import kernel
from edge.types import F64


@kernel
def exp_times(xi: F64, R: F64, t: F64, R_out: F64, t_out: F64) -> None:
    """Set R_out, t_out to exp(xi) @ (R, t).

    xi            (6,)    float64  twist, translation first
    R, R_out      (3, 3)  float64
    t, t_out      (3,)    float64  outputs must not overlap the inputs
    """
    x, y, z = xi[3], xi[4], xi[5]
    theta2 = x * x + y * y + z * z
    theta = math.sqrt(theta2)
    if theta < 1e-5:
        a, b, c = 1.0 - theta2 / 6.0, 0.5 - theta2 / 24.0, 1.0 / 6.0 - theta2 / 120.0
    else:
        a = math.sin(theta) / theta
        b = (1.0 - math.cos(theta)) / theta2
        c = (1.0 - a) / theta2
    for i in range(3):
        # Rows of E = I + a W + b W^2 and V = I + b W + c W^2, with W = hat(x, y, z).
        if i == 0:
            w0, w1, w2 = 0.0, -z, y
            q0, q1, q2 = -(y * y + z * z), x * y, x * z
            d0, d1, d2 = 1.0, 0.0, 0.0
        elif i == 1:
            w0, w1, w2 = z, 0.0, -x
            q0, q1, q2 = x * y, -(x * x + z * z), y * z
            d0, d1, d2 = 0.0, 1.0, 0.0
        else:
            w0, w1, w2 = -y, x, 0.0
            q0, q1, q2 = x * z, y * z, -(x * x + y * y)
            d0, d1, d2 = 0.0, 0.0, 1.0
        e0, e1, e2 = d0 + a * w0 + b * q0, d1 + a * w1 + b * q1, d2 + a * w2 + b * q2
        v0, v1, v2 = d0 + b * w0 + c * q0, d1 + b * w1 + c * q1, d2 + b * w2 + c * q2
        for j in range(3):
            R_out[i, j] = e0 * R[0, j] + e1 * R[1, j] + e2 * R[2, j]
        t_out[i] = e0 * t[0] + e1 * t[1] + e2 * t[2] + v0 * xi[0] + v1 * xi[1] + v2 * xi[2]


@kernel
def solve_symmetric(A: F64, b: F64, x: F64) -> bool:
    """Solve A x = b for a positive definite A by Cholesky; False where A is not.

    A  (n, n)  float64  destroyed; only its lower triangle is read
    b  (n,)    float64
    x  (n,)    float64  out
    """
    n = b.shape[0]
    for j in range(n):
        pivot = A[j, j]
        for k in range(j):
            pivot -= A[j, k] * A[j, k]
        if not pivot > 0.0:
            x[:] = 0.0
            return False
        pivot = math.sqrt(pivot)
        A[j, j] = pivot
        for i in range(j + 1, n):
            s = A[i, j]
            for k in range(j):
                s -= A[i, k] * A[j, k]
            A[i, j] = s / pivot
    for i in range(n):
        s = b[i]
        for k in range(i):
            s -= A[i, k] * x[k]
        x[i] = s / A[i, i]
    for i in range(n - 1, -1, -1):
        s = x[i]
        for k in range(i + 1, n):
            s -= A[k, i] * x[k]
        x[i] = s / A[i, i]
    return bool(np.all(np.isfinite(x)))
