# SPDX-License-Identifier: Apache-2.0
"""Projected lines and found segments paired by votes from samples along the lines' normals."""

import math

import numpy as np

from edge.kernel import kernel
from edge.types import F64, I32, Pinhole

_NEAR = 0.05  # of the line's own distance: what is nearer is cut off
_SAMPLE_EVERY_PX = 8.0
_MAX_SAMPLES = 24
_MIN_SAMPLES = 3
_SLACK_PX = 3.0  # beyond a segment's ends


@kernel
def project(first: F64, last: F64, T: F64, camera: Pinhole, margin_px: float, out: F64) -> int:
    """Set out (n, 4) to the parts of segments in space that are in the image; NaN for none.

    first, last  (n, 3)  float64  ends in the lines' frame
    T            (4, 4)  float64  camera from lines

    Returns how many are in the image.
    """
    a, b = np.empty(3), np.empty(3)
    seen = 0
    for i in range(first.shape[0]):
        for r in range(3):
            a[r], b[r] = T[r, 3], T[r, 3]
            for c in range(3):
                a[r] += T[r, c] * first[i, c]
                b[r] += T[r, c] * last[i, c]
        near = _NEAR * max(a[2], b[2])
        out[i, :] = math.nan
        if not near > 0.0:
            continue
        # Cut off what is behind the camera or just before it.
        for r in range(3):
            if r == 2:
                continue
            if a[2] < near:
                a[r] += (near - a[2]) / (b[2] - a[2]) * (b[r] - a[r])
            elif b[2] < near:
                b[r] += (near - b[2]) / (a[2] - b[2]) * (a[r] - b[r])
        za, zb = max(a[2], near), max(b[2], near)
        u0, v0 = camera.fx * a[0] / za + camera.cx, camera.fy * a[1] / za + camera.cy
        du = camera.fx * b[0] / zb + camera.cx - u0
        dv = camera.fy * b[1] / zb + camera.cy - v0
        low, high = 0.0, 1.0
        for side in range(4):  # Liang and Barsky's clipping
            if side < 2:
                step, place, size = du, u0, camera.width - 1.0
            else:
                step, place, size = dv, v0, camera.height - 1.0
            if side % 2 == 0:
                step, room = -step, place - margin_px
            else:
                room = size - margin_px - place
            if step < 0.0:
                low = max(low, room / step)
            elif step > 0.0:
                high = min(high, room / step)
            elif room < 0.0:
                high = -1.0
        if low < high:
            out[i, 0], out[i, 1] = u0 + low * du, v0 + low * dv
            out[i, 2], out[i, 3] = u0 + high * du, v0 + high * dv
            seen += 1
    return seen


@kernel
def vote(
    projected: F64,
    reach_px: F64,
    middle: F64,
    direction: F64,
    length: F64,
    cosine: float,
    match: I32,
    share: F64,
    offset_px: F64,
) -> None:
    """Choose for each projected line the segment that most of its samples meet.

    A segment must run as its line does: the direction of both tells which side is brighter.

    projected          (n, 4)  float64  ends in the image, NaN for lines that are not seen
    reach_px           (n,)    float64  how far along the normal a sample looks
    middle, direction  (m, 2)  float64  of segments
    length             (m,)    float64
    cosine             of the largest angle between a line and its segment
    match              (n,)    int32, out    segment, -1 for none
    share              (n,)    float64, out  of samples that met it
    offset_px          (n,)    float64, out  mean distance along the normal to it, signed
    """
    m = middle.shape[0]
    votes, sums = np.empty(m), np.empty(m)
    for i in range(projected.shape[0]):
        match[i], share[i], offset_px[i] = -1, 0.0, 0.0
        u0, v0 = projected[i, 0], projected[i, 1]
        extent = math.hypot(projected[i, 2] - u0, projected[i, 3] - v0)
        if not extent > 1.0:
            continue
        du, dv = (projected[i, 2] - u0) / extent, (projected[i, 3] - v0) / extent
        samples = min(max(int(extent / _SAMPLE_EVERY_PX), _MIN_SAMPLES), _MAX_SAMPLES)
        votes[:], sums[:] = 0.0, 0.0
        for j in range(m):
            gu, gv = direction[j, 0], direction[j, 1]
            slope = gu * du + gv * dv
            if slope < cosine:
                continue
            # Along the normal (-dv, du) of the line, from a sample to the segment's line.
            for k in range(samples):
                s = extent * (k + 0.5) / samples
                cu, cv = u0 + s * du - middle[j, 0], v0 + s * dv - middle[j, 1]
                o = -(cv * gu - cu * gv) / slope
                place = (cu - o * dv) * gu + (cv + o * du) * gv
                if abs(o) <= reach_px[i] and abs(place) <= 0.5 * length[j] + _SLACK_PX:
                    votes[j] += 1.0
                    sums[j] += o
        best, best_score = -1, 0.0
        for j in range(m):
            # Of as many votes the nearer segment wins.
            score = votes[j] - 1e-6 * abs(sums[j])
            if votes[j] > 0.0 and score > best_score:
                best, best_score = j, score
        if best >= 0:
            match[i], share[i] = best, votes[best] / samples
            offset_px[i] = sums[best] / votes[best]
