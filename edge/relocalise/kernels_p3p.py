# SPDX-License-Identifier: Apache-2.0
"""Camera poses from three bearings, by Persson and Nordberg's Lambda Twist (ECCV 2018)."""

import math

import numpy as np

from edge.kernel import inline_kernel, kernel
from edge.types import F64

_CUBIC_STEPS = 12
_POLISH_STEPS = 3
_TINY = 1e-15


@kernel
def p3p(y: F64, x: F64, R: F64, p: F64) -> int:
    """Write up to four poses that see three points along three bearings; return how many.

    y  (3, 3)     float64  unit bearings in the camera frame, a row each
    x  (3, 3)     float64  the points in the map frame
    R  (4, 3, 3)  float64, out  R_map_cam
    p  (4, 3)     float64, out  position of the camera in the map
    """
    b12 = -2.0 * (y[0, 0] * y[1, 0] + y[0, 1] * y[1, 1] + y[0, 2] * y[1, 2])
    b13 = -2.0 * (y[0, 0] * y[2, 0] + y[0, 1] * y[2, 1] + y[0, 2] * y[2, 2])
    b23 = -2.0 * (y[1, 0] * y[2, 0] + y[1, 1] * y[2, 1] + y[1, 2] * y[2, 2])
    a12 = (x[0, 0] - x[1, 0]) ** 2 + (x[0, 1] - x[1, 1]) ** 2 + (x[0, 2] - x[1, 2]) ** 2
    a13 = (x[0, 0] - x[2, 0]) ** 2 + (x[0, 1] - x[2, 1]) ** 2 + (x[0, 2] - x[2, 2]) ** 2
    a23 = (x[1, 0] - x[2, 0]) ** 2 + (x[1, 1] - x[2, 1]) ** 2 + (x[1, 2] - x[2, 2]) ** 2
    if min(a12, a13, a23) < _TINY:
        return 0
    g = _cubic(a12, a13, a23, b12, b13, b23)
    if not math.isfinite(g):
        return 0

    # The degenerate conic D0 + g D1, whose two lines are w0 + s w1 for s = +-v.
    d00 = a23 * (1.0 - g)
    d01 = a23 * b12 * 0.5
    d02 = a23 * b13 * g * -0.5
    d11 = a23 - a12 + a13 * g
    d12 = b23 * (a13 * g - a12) * 0.5
    d22 = g * (a13 - a23) - a12
    trace = d00 + d11 + d22
    minors = d00 * (d11 + d22) + d11 * d22 - d01 * d01 - d02 * d02 - d12 * d12
    root = math.sqrt(max(0.0, trace * trace - 4.0 * minors))
    e0, e1 = 0.5 * (trace + root), 0.5 * (trace - root)
    if abs(e0) < abs(e1):
        e0, e1 = e1, e0
    if abs(e0) < _TINY:
        return 0
    v00, v10, v20 = _eigenvector(e0, d00, d01, d02, d11, d12)
    v01, v11, v21 = _eigenvector(e1, d00, d01, d02, d11, d12)
    v = math.sqrt(max(0.0, -e1 / e0))

    n = 0
    for sign in range(2):
        s = v if sign == 0 else -v
        w2 = 1.0 / (s * v01 - v00)
        w0 = (v10 - s * v11) * w2
        w1 = (v20 - s * v21) * w2
        a = 1.0 / ((a13 - a12) * w1 * w1 - a12 * b13 * w1 - a12)
        b = (a13 * b12 * w1 - a12 * b13 * w0 - 2.0 * w0 * w1 * (a12 - a13)) * a
        c = ((a13 - a12) * w0 * w0 + a13 * b12 * w0 + a13) * a
        discriminant = b * b - 4.0 * c
        if not discriminant >= 0.0:
            continue
        discriminant = math.sqrt(discriminant)
        for which in range(2):
            tau = 0.5 * (-b + discriminant) if which == 0 else 0.5 * (-b - discriminant)
            if not tau > 0.0:
                continue
            square = a23 / (tau * (b23 + tau) + 1.0)
            if not square > 0.0:
                continue
            l2 = math.sqrt(square)
            l3 = tau * l2
            l1 = w0 * l2 + w1 * l3
            if not l1 > 0.0 or n == 4:
                continue
            l1, l2, l3 = _polished(l1, l2, l3, a12, a13, a23, b12, b13, b23)
            if _pose(y, x, l1, l2, l3, R[n], p[n]):
                n += 1
    return n


@inline_kernel
def _cubic(a12, a13, a23, b12, b13, b23):  # type: ignore[no-untyped-def]
    """A root g that makes the conic degenerate; the sharpest one, so that it is a simple root."""
    c31, c23, c12 = -0.5 * b13, -0.5 * b23, -0.5 * b12
    blob = c12 * c23 * c31 - 1.0
    s31, s23, s12 = 1.0 - c31 * c31, 1.0 - c23 * c23, 1.0 - c12 * c12
    p3 = a13 * (a23 * s31 - a13 * s23)
    p2 = 2.0 * blob * a23 * a13 + a13 * (2.0 * a12 + a13) * s23 + a23 * (a23 - a12) * s31
    p1 = a23 * (a13 - a23) * s12 - a12 * a12 * s23 - 2.0 * a12 * (blob * a23 + a13 * s23)
    p0 = a12 * (a12 * s23 - a23 * s12)
    if abs(p3) < 1e-12 * abs(p2):
        p3 = 1e-12 * p2
    b, c, d = p2 / p3, p1 / p3, p0 / p3
    if b * b >= 3.0 * c:
        v = math.sqrt(b * b - 3.0 * c)
        r = (-b - v) / 3.0
        k = ((r + b) * r + c) * r + d
        if k > 0.0:
            r -= math.sqrt(max(0.0, -k / (3.0 * r + b)))
        else:
            r = (-b + v) / 3.0
            k = ((r + b) * r + c) * r + d
            r += math.sqrt(max(0.0, -k / (3.0 * r + b)))
    else:
        r = -b / 3.0
        if abs((3.0 * r + 2.0 * b) * r + c) < 1e-4:
            r += 1.0
    for _ in range(_CUBIC_STEPS):
        slope = (3.0 * r + 2.0 * b) * r + c
        if slope == 0.0:
            break
        step = (((r + b) * r + c) * r + d) / slope
        r -= step
        if abs(step) < 1e-14 * abs(r):
            break
    return r


@inline_kernel
def _eigenvector(e, d00, d01, d02, d11, d12):  # type: ignore[no-untyped-def]
    """Unit eigenvector of the conic for its eigenvalue e."""
    t = 1.0 / (e * (d00 + d11) - d00 * d11 - e * e + d01 * d01)
    a = -(e * d02 + d01 * d12 - d02 * d11) * t
    b = -(e * d12 + d01 * d02 - d00 * d12) * t
    r = 1.0 / math.sqrt(a * a + b * b + 1.0)
    return a * r, b * r, r


@inline_kernel
def _polished(l1, l2, l3, a12, a13, a23, b12, b13, b23):  # type: ignore[no-untyped-def]
    """Distances along the bearings after Gauss-Newton on the three cosine laws."""
    for _ in range(_POLISH_STEPS):
        r1 = l1 * l1 + l2 * l2 + b12 * l1 * l2 - a12
        r2 = l1 * l1 + l3 * l3 + b13 * l1 * l3 - a13
        r3 = l2 * l2 + l3 * l3 + b23 * l2 * l3 - a23
        j11, j12 = 2.0 * l1 + b12 * l2, 2.0 * l2 + b12 * l1
        j21, j23 = 2.0 * l1 + b13 * l3, 2.0 * l3 + b13 * l1
        j32, j33 = 2.0 * l2 + b23 * l3, 2.0 * l3 + b23 * l2
        determinant = -j11 * j23 * j32 - j12 * j21 * j33
        if determinant == 0.0:
            break
        f = 1.0 / determinant
        l1 -= f * (-j23 * j32 * r1 - j12 * j33 * r2 + j12 * j23 * r3)
        l2 -= f * (-j21 * j33 * r1 + j11 * j33 * r2 - j11 * j23 * r3)
        l3 -= f * (j21 * j32 * r1 - j11 * j32 * r2 - j12 * j21 * r3)
    return l1, l2, l3


@inline_kernel
def _pose(y, x, l1, l2, l3, R, p):  # type: ignore[no-untyped-def]
    """R_map_cam and position from the points' camera coordinates; False where they are in line.

    Both triangles have equal sides, so equal Gram-Schmidt frames: their quotient is a rotation.
    """
    ax, ay, az = x[1, 0] - x[0, 0], x[1, 1] - x[0, 1], x[1, 2] - x[0, 2]
    bx, by, bz = x[2, 0] - x[0, 0], x[2, 1] - x[0, 1], x[2, 2] - x[0, 2]
    cx, cy, cz = l1 * y[0, 0], l1 * y[0, 1], l1 * y[0, 2]
    dx, dy, dz = l2 * y[1, 0] - cx, l2 * y[1, 1] - cy, l2 * y[1, 2] - cz
    ex, ey, ez = l3 * y[2, 0] - cx, l3 * y[2, 1] - cy, l3 * y[2, 2] - cz

    n = 1.0 / math.sqrt(ax * ax + ay * ay + az * az)
    ax, ay, az = ax * n, ay * n, az * n
    k = ax * bx + ay * by + az * bz
    bx, by, bz = bx - k * ax, by - k * ay, bz - k * az
    m = 1.0 / math.sqrt(dx * dx + dy * dy + dz * dz)
    dx, dy, dz = dx * m, dy * m, dz * m
    k = dx * ex + dy * ey + dz * ez
    ex, ey, ez = ex - k * dx, ey - k * dy, ez - k * dz
    q = math.sqrt(bx * bx + by * by + bz * bz)
    r = math.sqrt(ex * ex + ey * ey + ez * ez)
    if not (n * q > 1e-9 and m * r > 1e-9):
        return False
    bx, by, bz = bx / q, by / q, bz / q
    ex, ey, ez = ex / r, ey / r, ez / r
    fx, fy, fz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    gx, gy, gz = dy * ez - dz * ey, dz * ex - dx * ez, dx * ey - dy * ex

    R[0, 0] = ax * dx + bx * ex + fx * gx
    R[0, 1] = ax * dy + bx * ey + fx * gy
    R[0, 2] = ax * dz + bx * ez + fx * gz
    R[1, 0] = ay * dx + by * ex + fy * gx
    R[1, 1] = ay * dy + by * ey + fy * gy
    R[1, 2] = ay * dz + by * ez + fy * gz
    R[2, 0] = az * dx + bz * ex + fz * gx
    R[2, 1] = az * dy + bz * ey + fz * gy
    R[2, 2] = az * dz + bz * ez + fz * gz
    for i in range(3):
        p[i] = x[0, i] - (R[i, 0] * cx + R[i, 1] * cy + R[i, 2] * cz)
    return bool(np.isfinite(p[0] + p[1] + p[2] + R[0, 0]))
