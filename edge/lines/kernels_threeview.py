# SPDX-License-Identifier: Apache-2.0
"""Segments matched over three views of known pose, by the trifocal tensor.

With cameras [1 | 0], [A | a], [B | b] the tensor is T_i^jk = A_ji b_k - a_j B_ki (Hartley and
Zisserman 2004, 15.1). A point x of the first view on a line whose image in the second view is l
is seen in the third at x_k = sum_ij x_i l_j T_i^jk (15.3.1): ends of a segment are transferred
through the segment that is tried in the second view, and must fall along one in the third.
"""

import math

import numpy as np

from edge.kernel import inline_kernel, kernel
from edge.types import F32, F64, I32

PROFILE = 6  # grey values of each side of a segment
_STEP_PX = 1.25
_FIRST_PX = 1.0
_PLACES = 16  # along


@kernel
def profiles(image: F32, ends: F64, out: F32) -> None:
    """Grey values beside segments, going outwards, averaged along them.

    image  (h, w)  float32  or uint8
    ends   (n, 4)  float64  u0 v0 u1 v1
    out    (n, 2, PROFILE)  float32  left and right of the direction; -1 where out of the image
    """
    height, width = image.shape
    for i in range(ends.shape[0]):
        u0, v0 = ends[i, 0], ends[i, 1]
        length = math.hypot(ends[i, 2] - u0, ends[i, 3] - v0)
        if not length > 0.0:
            out[i, :, :] = -1.0
            continue
        du, dv = (ends[i, 2] - u0) / length, (ends[i, 3] - v0) / length
        for side in range(2):
            sign = 1.0 - 2.0 * side
            for k in range(PROFILE):
                away = sign * (_FIRST_PX + _STEP_PX * k)
                total, count = 0.0, 0
                for j in range(_PLACES):
                    s = length * (j + 0.5) / _PLACES
                    u, v = u0 + s * du + away * dv, v0 + s * dv - away * du
                    if u < 0.0 or v < 0.0 or u >= width - 1.0 or v >= height - 1.0:
                        continue
                    x, y = int(u), int(v)
                    fu, fv = u - x, v - y
                    top = (1.0 - fu) * image[y, x] + fu * image[y, x + 1]
                    low = (1.0 - fu) * image[y + 1, x] + fu * image[y + 1, x + 1]
                    total += (1.0 - fv) * top + fv * low
                    count += 1
                out[i, side, k] = total / count if 2 * count >= _PLACES else -1.0


@inline_kernel
def _unlike(a, i, b, j):  # type: ignore[no-untyped-def]
    """Difference of two segments' profiles [grey]: that of the side which is more alike.

    Only one side is part of the thing whose outline a segment is.
    """
    best = math.inf
    for side in range(2):
        total, count = 0.0, 0
        for k in range(PROFILE):
            if a[i, side, k] >= 0.0 and b[j, side, k] >= 0.0:
                total += abs(a[i, side, k] - b[j, side, k])
                count += 1
        if count > 0 and total / count < best:
            best = total / count
    return best


@inline_kernel
def _through(T, l0, l1, l2, x, y, out):  # type: ignore[no-untyped-def]
    """Set out (3,) to where a point (x, y, 1) goes through a line of the second view."""
    for k in range(3):
        total = 0.0
        for i in range(3):
            xi = x if i == 0 else (y if i == 1 else 1.0)
            total += xi * (l0 * T[i, 0, k] + l1 * T[i, 1, k] + l2 * T[i, 2, k])
        out[k] = total


@kernel
def tensor(second: F64, third: F64, out: F64) -> None:
    """Set out (3, 3, 3) to the tensor of cameras [1 | 0], `second` and `third` (3, 4)."""
    for i in range(3):
        for j in range(3):
            for k in range(3):
                out[i, j, k] = second[j, i] * third[k, 3] - second[j, 3] * third[k, i]


@kernel
def match(
    ends: F64,
    grey: F32,
    others_start: I32,
    others_ends: F64,
    others_grey: F32,
    T: F64,
    focal: float,
    depth_range: F64,
    reach_px: float,
    cosine: float,
    max_grey: float,
    best: I32,
    score: F64,
) -> None:
    """Find the segments of other views that show the same line as each segment of the first.

    ends          (n, 4)  float64  of the first view's segments, in focal lengths from its axis
    grey          (n, 2, PROFILE)  float32  their profiles
    others_start  (m + 1,)  int32  rows of each other view in the two that follow
    others_ends   (o, 4)  float64
    others_grey   (o, 2, PROFILE)  float32
    T             (m, 3, 4)  float64  other from first camera
    focal         [px], by which distances are told
    depth_range   (2,)  float64  of the ends along the axis of the first camera
    reach_px      how far from its segment a transferred end may fall
    cosine        of the largest angle between a transferred segment and one of the third view
    max_grey      of profiles of the same line
    best          (n, m)  int32, out   segment in each other view, -1 for none
    score         (n,)  float64, out   views that agree, the first included, less their distance
    """
    views = T.shape[0]
    tensors = np.empty((views, views, 3, 3, 3))
    for j in range(views):
        for k in range(views):
            tensor(T[j], T[k], tensors[j, k])
    a, b = np.empty(3), np.empty(3)
    found = np.empty(views, np.int32)
    for i in range(ends.shape[0]):
        best[i, :] = -1
        score[i] = 0.0
        for j in range(views):
            for t in range(others_start[j], others_start[j + 1]):
                off = _second(ends, i, others_ends, t, T[j], depth_range)
                if off < 0.0:
                    continue
                own = _unlike(grey, i, others_grey, t)
                if own > max_grey:
                    continue
                u0, v0, u1, v1 = (
                    others_ends[t, 0], others_ends[t, 1], others_ends[t, 2], others_ends[t, 3],
                )  # fmt: skip
                l0, l1, l2 = v0 - v1, u1 - u0, u0 * v1 - u1 * v0
                found[:] = -1
                found[j] = t - others_start[j]
                total = 2.0 - own / max_grey / 4.0
                for k in range(views):
                    if k == j:
                        continue
                    _through(tensors[j, k], l0, l1, l2, ends[i, 0], ends[i, 1], a)
                    _through(tensors[j, k], l0, l1, l2, ends[i, 2], ends[i, 3], b)
                    if a[2] == 0.0 or b[2] == 0.0 or a[2] * b[2] < 0.0:
                        continue
                    x0, y0, x1, y1 = a[0] / a[2], a[1] / a[2], b[0] / b[2], b[1] / b[2]
                    extent = math.hypot(x1 - x0, y1 - y0)
                    if not extent > 0.0:
                        continue
                    nearest, least = -1, math.inf
                    for u in range(others_start[k], others_start[k + 1]):
                        p0, q0 = others_ends[u, 0], others_ends[u, 1]
                        length = math.hypot(others_ends[u, 2] - p0, others_ends[u, 3] - q0)
                        d0, d1 = (
                            (others_ends[u, 2] - p0) / length,
                            (others_ends[u, 3] - q0) / length,
                        )
                        if d0 * (x1 - x0) + d1 * (y1 - y0) < cosine * extent:
                            continue
                        s0 = d0 * (x0 - p0) + d1 * (y0 - q0)
                        s1 = d0 * (x1 - p0) + d1 * (y1 - q0)
                        both = min(s1, length) - max(s0, 0.0)
                        if both < 0.4 * min(s1 - s0, length):
                            continue
                        # Measured at the ends of the part that both have: beyond them nothing is
                        # known, and a short piece tells a direction badly.
                        w0 = d0 * (y0 - q0) - d1 * (x0 - p0)
                        w1 = d0 * (y1 - q0) - d1 * (x1 - p0)
                        slope = (w1 - w0) / max(s1 - s0, 1e-12)
                        low, high = max(s0, 0.0), min(s1, length)
                        e = max(abs(w0 + slope * (low - s0)), abs(w0 + slope * (high - s0)))
                        e = focal * e / reach_px
                        if e < least and e < 1.0:
                            alike = _unlike(grey, i, others_grey, u) / max_grey
                            if alike < 1.0 and e + alike < least:
                                nearest, least = u, e + alike
                    if nearest >= 0:
                        found[k] = nearest - others_start[k]
                        total += 1.0 - 0.2 * least
                if total > score[i]:
                    score[i] = total
                    best[i, :] = found


@inline_kernel
def _second(ends, i, others, t, T, depth_range):  # type: ignore[no-untyped-def]
    """Share of segment t that segment i covers through it; -1 where they can be no one line.

    Each end is searched along the piece of its epipolar line that belongs to possible depths.
    """
    u0, v0, u1, v1 = others[t, 0], others[t, 1], others[t, 2], others[t, 3]
    l0, l1, l2 = v0 - v1, u1 - u0, u0 * v1 - u1 * v0
    length = math.hypot(u1 - u0, v1 - v0)
    d0, d1 = (u1 - u0) / length, (v1 - v0) / length
    s0, s1 = 0.0, 0.0
    for e in range(2):
        x, y = ends[i, 2 * e], ends[i, 2 * e + 1]
        r0 = T[0, 0] * x + T[0, 1] * y + T[0, 2]
        r1 = T[1, 0] * x + T[1, 1] * y + T[1, 2]
        r2 = T[2, 0] * x + T[2, 1] * y + T[2, 2]
        below = l0 * r0 + l1 * r1 + l2 * r2
        if below == 0.0:
            return -1.0
        z = -(l0 * T[0, 3] + l1 * T[1, 3] + l2 * T[2, 3]) / below
        if not (depth_range[0] < z < depth_range[1]):
            return -1.0
        z2 = z * r2 + T[2, 3]
        if not z2 > 0.0:
            return -1.0
        s = d0 * ((z * r0 + T[0, 3]) / z2 - u0) + d1 * ((z * r1 + T[1, 3]) / z2 - v0)
        if e == 0:
            s0 = s
        else:
            s1 = s
    # The brighter side stays on its hand, so the direction does.
    if not s1 > s0:
        return -1.0
    both = min(s1, length) - max(s0, 0.0)
    share = both / min(s1 - s0, length)
    return share if share > 0.4 else -1.0
