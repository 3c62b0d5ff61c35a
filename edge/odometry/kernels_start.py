# SPDX-License-Identifier: Apache-2.0
"""Bundle adjustment of a few frames and the points of one: for the start of the odometry."""

import numpy as np

from edge.kernel import kernel
from edge.types import F64, U8


@kernel
def accumulate(
    rays: F64,
    idepth: F64,
    observed: F64,
    seen: U8,
    R: F64,
    t: F64,
    huber: float,
    H: F64,
    b: F64,
    Hd: F64,
    bd: F64,
    W: F64,
    squared: F64,
) -> float:
    """Gauss-Newton system of reprojection residuals, reference frame fixed.

    rays      (n, 2)     float64  x/z, y/z in the reference
    idepth    (n,)       float64  inverse depth there
    observed  (m, n, 2)  float64  x/z, y/z in the other frames
    seen      (m, n)     uint8
    R, t      (m, 3, 3), (m, 3)   T_frame_reference
    H, b      (6 m, 6 m), (6 m,)  float64, out; block diagonal in H
    Hd, bd    (n,)       float64, out
    W         (6 m, n)   float64, out
    squared   (m, n)     float64, out: squared residuals

    Returns the Huber cost.
    """
    H[:], b[:], Hd[:], bd[:], W[:] = 0.0, 0.0, 0.0, 0.0, 0.0
    cost = 0.0
    ju, jv = np.empty(6), np.empty(6)
    for m in range(observed.shape[0]):
        for i in range(rays.shape[0]):
            squared[m, i] = 0.0
            if seen[m, i] == 0:
                continue
            x, y, d = rays[i, 0], rays[i, 1], idepth[i]
            pz = R[m, 2, 0] * x + R[m, 2, 1] * y + R[m, 2, 2] + t[m, 2] * d
            if pz < 1e-2:
                cost += 4.0 * huber * huber
                squared[m, i] = 1e6
                continue
            px = R[m, 0, 0] * x + R[m, 0, 1] * y + R[m, 0, 2] + t[m, 0] * d
            py = R[m, 1, 0] * x + R[m, 1, 1] * y + R[m, 1, 2] + t[m, 1] * d
            inv = 1.0 / pz
            X, Y = px * inv, py * inv
            ru, rv = X - observed[m, i, 0], Y - observed[m, i, 1]
            r2 = ru * ru + rv * rv
            squared[m, i] = r2
            r = np.sqrt(r2)
            w = 1.0 if r < huber else huber / r
            cost += w * r2 * (2.0 - w)
            nid = d * inv
            ju[0], ju[1], ju[2], ju[3], ju[4], ju[5] = nid, 0.0, -X * nid, -X * Y, 1 + X * X, -Y
            jv[0], jv[1], jv[2], jv[3], jv[4], jv[5] = 0.0, nid, -Y * nid, -1 - Y * Y, X * Y, X
            du, dv = inv * (t[m, 0] - t[m, 2] * X), inv * (t[m, 1] - t[m, 2] * Y)
            Hd[i] += w * (du * du + dv * dv)
            bd[i] += w * (du * ru + dv * rv)
            for j in range(6):
                b[6 * m + j] += w * (ju[j] * ru + jv[j] * rv)
                W[6 * m + j, i] = w * (ju[j] * du + jv[j] * dv)
                for k in range(6):
                    H[6 * m + j, 6 * m + k] += w * (ju[j] * ju[k] + jv[j] * jv[k])
    return cost
