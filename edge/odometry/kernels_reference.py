# SPDX-License-Identifier: Apache-2.0
"""The newest keyframe's semi-dense inverse depth, at all pyramid levels."""

import numpy as np

from edge.kernel import kernel
from edge.types import F32, I32, U8

ZERO, ONE = np.float32(0.0), np.float32(1.0)


@kernel
def project_points(
    points: F32, host: I32, warp: F32, intrinsics: F32, target: int, out: F32
) -> None:
    """Project every point into the target frame.

    points  (20, n)     float32  u, v, inverse depth in their hosts
    host    (n,)        int32
    warp    (f, f, 12)  float32  [host, target]
    out     (3, n)      float32, out: u, v [px], inverse depth (0 behind the camera)
    """
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    for i in range(points.shape[1]):
        h = host[i]
        u, v, idepth = points[0, i], points[1, i], points[2, i]
        if h != target:
            x, y = (u - cx) / fx, (v - cy) / fy
            T = warp[h, target]
            z = T[6] * x + T[7] * y + T[8] + T[11] * idepth
            if z < np.float32(1e-3):
                out[0, i], out[1, i], out[2, i] = ZERO, ZERO, ZERO
                continue
            u = fx * (T[0] * x + T[1] * y + T[2] + T[9] * idepth) / z + cx
            v = fy * (T[3] * x + T[4] * y + T[5] + T[10] * idepth) / z + cy
            idepth = idepth / z
        out[0, i], out[1, i], out[2, i] = u, v, idepth


@kernel
def splat(projected: F32, weight: F32, depth: F32, total: F32) -> None:
    """Add weighted inverse depths at their nearest pixels.

    projected      (3, n)  float32
    weight         (n,)    float32  0 leaves a point out
    depth, total   (h, w)  float32, in and out: sums of weight * inverse depth, and of weights
    """
    height, width = depth.shape
    for i in range(projected.shape[1]):
        if weight[i] <= ZERO or projected[2, i] <= ZERO:
            continue
        x, y = int(projected[0, i] + 0.5), int(projected[1, i] + 0.5)
        if 2 < x < width - 3 and 2 < y < height - 3:
            depth[y, x] += weight[i] * projected[2, i]
            total[y, x] += weight[i]


@kernel
def halve_sums(depth: F32, total: F32, depth_out: F32, total_out: F32) -> None:
    """Sum 2x2 cells of both maps."""
    for y in range(depth_out.shape[0]):
        for x in range(depth_out.shape[1]):
            a, b = 2 * y, 2 * x
            depth_out[y, x] = depth[a, b] + depth[a, b + 1] + depth[a + 1, b] + depth[a + 1, b + 1]
            total_out[y, x] = total[a, b] + total[a, b + 1] + total[a + 1, b] + total[a + 1, b + 1]


@kernel
def collect(
    level: F32,
    mask: U8,
    depth: F32,
    total: F32,
    intrinsics: F32,
    offset: np.float32,
    dilate: int,
    out: F32,
) -> int:
    """List the pixels that have a depth, or a neighbour with one, as tracking points.

    level   (h, w, 3)  float32  of the keyframe
    offset  its brightness offset b
    dilate  0 none, 1 the four straight neighbours, 2 the four diagonal ones
    out     (5, m)     float32, out: x/z, y/z, inverse depth, grey - b, weight

    Returns how many were written.
    """
    height, width = mask.shape
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    count, capacity = 0, out.shape[1]
    for y in range(1, height - 1):
        for x in range(1, width - 1):
            if mask[y, x] == 0 or count >= capacity:
                continue
            d, w = depth[y, x], total[y, x]
            if w <= ZERO:
                if dilate == 1:
                    d = depth[y - 1, x] + depth[y + 1, x] + depth[y, x - 1] + depth[y, x + 1]
                    w = total[y - 1, x] + total[y + 1, x] + total[y, x - 1] + total[y, x + 1]
                elif dilate == 2:
                    d = (
                        depth[y - 1, x - 1]
                        + depth[y - 1, x + 1]
                        + depth[y + 1, x - 1]
                        + depth[y + 1, x + 1]
                    )
                    w = (
                        total[y - 1, x - 1]
                        + total[y - 1, x + 1]
                        + total[y + 1, x - 1]
                        + total[y + 1, x + 1]
                    )
            if w <= ZERO:
                continue
            out[0, count] = (np.float32(x) - cx) / fx
            out[1, count] = (np.float32(y) - cy) / fy
            out[2, count] = d / w
            out[3, count] = level[y, x, 0] - offset
            out[4, count] = ONE
            count += 1
    return count
