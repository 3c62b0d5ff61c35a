# SPDX-License-Identifier: Apache-2.0
"""How far a motion moves the image of points."""

from edge.kernel import kernel
from edge.types import F32, F64


@kernel
def mean_flow(points: F32, n: int, intrinsics: F32, R: F64, t: F64, out: F64) -> None:
    """Mean squared image motion of `points` [px^2]: whole, by translation, by rotation.

    Arguments as of `kernels_track.accumulate`; out (4,) float64, the last the share of points
    ahead.
    """
    fx, fy = float(intrinsics[0]), float(intrinsics[1])
    out[:] = 0.0
    count = 0
    for i in range(n):
        x, y, idepth = float(points[0, i]), float(points[1, i]), float(points[2, i])
        ax, ay = R[0, 0] * x + R[0, 1] * y + R[0, 2], R[1, 0] * x + R[1, 1] * y + R[1, 2]
        az = R[2, 0] * x + R[2, 1] * y + R[2, 2]
        bz = az + t[2] * idepth
        cz = 1.0 + t[2] * idepth
        if az < 0.05 or bz < 0.05 or cz < 0.05:
            continue
        du = fx * ((ax + t[0] * idepth) / bz - x)
        dv = fy * ((ay + t[1] * idepth) / bz - y)
        out[0] += du * du + dv * dv
        du, dv = fx * ((x + t[0] * idepth) / cz - x), fy * ((y + t[1] * idepth) / cz - y)
        out[1] += du * du + dv * dv
        du, dv = fx * (ax / az - x), fy * (ay / az - y)
        out[2] += du * du + dv * dv
        count += 1
    for k in range(3):
        out[k] /= max(count, 1)
    out[3] = count / max(n, 1)
