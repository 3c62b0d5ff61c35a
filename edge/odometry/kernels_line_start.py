# SPDX-License-Identifier: Apache-2.0
"""Edges in the first bundle adjustment: of a point on one, only its distance to it is seen."""

import numpy as np

from edge.kernel import kernel
from edge.types import F64, U8

_NEAR = 1e-2
_BEHIND = 1e6


@kernel
def accumulate(
    rays: F64,
    idepth: F64,
    line: F64,
    seen: U8,
    R: F64,
    t: F64,
    limit: float,
    H: F64,
    b: F64,
    Hd: F64,
    bd: F64,
    W: F64,
    squared: F64,
) -> float:
    """Gauss-Newton system of distances to lines, reference frame fixed.

    rays      (n, 2)        float64  x/z, y/z of points on edges of the reference
    idepth    (n,)          float64  inverse depth there
    line      (m, n, 2, 3)  float64  a x + b y + c of the edges that meet there, in the other
                            frames, a a + b b = 1; zeros where there is one only
    seen      (m, n)        uint8
    R, t      (m, 3, 3), (m, 3)   T_frame_reference
    limit     distance at which a point counts a quarter, less beyond (Geman-McClure)
    H, b      (6 m, 6 m), (6 m,)  float64, out; block diagonal in H
    Hd, bd    (n,)          float64, out
    W         (6 m, n)      float64, out
    squared   (m, n)        float64, out: squared distances, of both edges together

    Returns the robust cost.
    """
    H[:], b[:], Hd[:], bd[:], W[:] = 0.0, 0.0, 0.0, 0.0, 0.0
    cost, far = 0.0, 1.0 / (limit * limit)
    J = np.empty(6)
    for m in range(line.shape[0]):
        for i in range(rays.shape[0]):
            squared[m, i] = 0.0
            if seen[m, i] == 0:
                continue
            x, y, d = rays[i, 0], rays[i, 1], idepth[i]
            pz = R[m, 2, 0] * x + R[m, 2, 1] * y + R[m, 2, 2] + t[m, 2] * d
            if pz < _NEAR:
                cost += limit * limit
                squared[m, i] = _BEHIND
                continue
            px = R[m, 0, 0] * x + R[m, 0, 1] * y + R[m, 0, 2] + t[m, 0] * d
            py = R[m, 1, 0] * x + R[m, 1, 1] * y + R[m, 1, 2] + t[m, 1] * d
            inv = 1.0 / pz
            X, Y = px * inv, py * inv
            total = 0.0
            for e in range(2):
                r = line[m, i, e, 0] * X + line[m, i, e, 1] * Y + line[m, i, e, 2]
                total += r * r
            squared[m, i] = total
            w = 1.0 / (1.0 + total * far)
            cost += total * w
            w *= w
            nid = d * inv
            for e in range(2):
                nu, nv = line[m, i, e, 0], line[m, i, e, 1]
                away = nu * X + nv * Y
                r = away + line[m, i, e, 2]
                J[0], J[1], J[2] = nu * nid, nv * nid, -away * nid
                J[3], J[4], J[5] = -away * Y - nv, away * X + nu, nv * X - nu * Y
                dr = inv * (nu * t[m, 0] + nv * t[m, 1] - away * t[m, 2])
                Hd[i] += w * dr * dr
                bd[i] += w * dr * r
                for j in range(6):
                    b[6 * m + j] += w * J[j] * r
                    W[6 * m + j, i] += w * J[j] * dr
                    for k in range(6):
                        H[6 * m + j, 6 * m + k] += w * J[j] * J[k]
    return cost
