# SPDX-License-Identifier: Apache-2.0
"""Which pixels become candidates: strong gradients, spread over the image."""

import math

import numpy as np

from edge.kernel import kernel
from edge.types import F32, I32, U8

REGION_PX = 32
MAX_GRADIENT = 64


@kernel
def region_thresholds(level: F32, mask: U8, quantile: float, margin_grey: float, out: F32) -> None:
    """Squared gradient that a pixel must exceed, per region of 32x32 px, smoothed 3x3.

    level  (h, w, 3)  float32
    out    (ceil(h/32), ceil(w/32))  float32 [grey^2/px^2], out
    The `quantile` of the region's gradients plus `margin_grey` (Engel et al. 2018, sec. 3.2).
    """
    height, width = mask.shape
    rows, columns = out.shape
    raw = np.zeros((rows, columns))
    histogram = np.zeros(MAX_GRADIENT + 1, np.int32)
    for j in range(rows):
        for i in range(columns):
            histogram[:] = 0
            count = 0
            for y in range(j * REGION_PX, min((j + 1) * REGION_PX, height)):
                for x in range(i * REGION_PX, min((i + 1) * REGION_PX, width)):
                    if mask[y, x] == 0:
                        continue
                    gx, gy = level[y, x, 1], level[y, x, 2]
                    g = int(math.sqrt(gx * gx + gy * gy))
                    histogram[min(g, MAX_GRADIENT)] += 1
                    count += 1
            wanted, passed, g = quantile * count, 0, 0
            while g < MAX_GRADIENT and passed + histogram[g] < wanted:
                passed += histogram[g]
                g += 1
            raw[j, i] = g + margin_grey
    for j in range(rows):
        for i in range(columns):
            total, count = 0.0, 0
            for y in range(max(j - 1, 0), min(j + 2, rows)):
                for x in range(max(i - 1, 0), min(i + 2, columns)):
                    total += raw[y, x]
                    count += 1
            out[j, i] = (total / count) ** 2


@kernel
def pick(level: F32, mask: U8, thresholds: F32, spacing: int, out: I32) -> int:
    """Pick the strongest pixel of each cell, weaker ones where a whole neighbourhood is empty.

    thresholds  as of `region_thresholds`
    spacing     cell size [px]; cells of 2 and 4 times that size are tried where
                no smaller one inside gave a pixel, with 0.75 of the threshold each
    out         (3, n)  int32, out: u, v, cell size in spacings (1, 2 or 4)

    Returns how many were written; stops when `out` is full.
    """
    height, width = mask.shape
    count, capacity = 0, out.shape[1]
    for y4 in range(0, height, 4 * spacing):
        for x4 in range(0, width, 4 * spacing):
            found4 = False
            best4, u4, v4 = 0.0, -1, -1
            for y2 in range(y4, min(y4 + 4 * spacing, height), 2 * spacing):
                for x2 in range(x4, min(x4 + 4 * spacing, width), 2 * spacing):
                    found2 = False
                    best2, u2, v2 = 0.0, -1, -1
                    for y1 in range(y2, min(y2 + 2 * spacing, height), spacing):
                        for x1 in range(x2, min(x2 + 2 * spacing, width), spacing):
                            best1, u1, v1 = 0.0, -1, -1
                            for y in range(y1, min(y1 + spacing, height)):
                                for x in range(x1, min(x1 + spacing, width)):
                                    if mask[y, x] == 0:
                                        continue
                                    gx, gy = level[y, x, 1], level[y, x, 2]
                                    g = gx * gx + gy * gy
                                    limit = thresholds[y // REGION_PX, x // REGION_PX]
                                    if g > limit and g > best1:
                                        best1, u1, v1 = g, x, y
                                    if g > 0.5625 * limit and g > best2:
                                        best2, u2, v2 = g, x, y
                                    if g > 0.3164 * limit and g > best4:
                                        best4, u4, v4 = g, x, y
                            if u1 >= 0:
                                found2 = found4 = True
                                if count < capacity:
                                    out[0, count], out[1, count], out[2, count] = u1, v1, 1
                                    count += 1
                    if not found2 and u2 >= 0:
                        found4 = True
                        if count < capacity:
                            out[0, count], out[1, count], out[2, count] = u2, v2, 2
                            count += 1
            if not found4 and u4 >= 0 and count < capacity:
                out[0, count], out[1, count], out[2, count] = u4, v4, 4
                count += 1
    return count


@kernel
def distance_map(u: F32, v: F32, n: int, out: F32) -> None:
    """Distance [px] of every pixel to the nearest of n points, by two chamfer passes.

    out  (h, w)  float32
    """
    height, width = out.shape
    far, straight, slant = np.float32(1e3), np.float32(1.0), np.float32(1.4142)
    out[:] = far
    for i in range(n):
        x, y = int(u[i] + 0.5), int(v[i] + 0.5)
        if 0 <= x < width and 0 <= y < height:
            out[y, x] = 0.0
    for y in range(height):
        for x in range(width):
            d = out[y, x]
            if x > 0:
                d = min(d, out[y, x - 1] + straight)
            if y > 0:
                d = min(d, out[y - 1, x] + straight)
                if x > 0:
                    d = min(d, out[y - 1, x - 1] + slant)
                if x < width - 1:
                    d = min(d, out[y - 1, x + 1] + slant)
            out[y, x] = d
    for y in range(height - 1, -1, -1):
        for x in range(width - 1, -1, -1):
            d = out[y, x]
            if x < width - 1:
                d = min(d, out[y, x + 1] + straight)
            if y < height - 1:
                d = min(d, out[y + 1, x] + straight)
                if x < width - 1:
                    d = min(d, out[y + 1, x + 1] + slant)
                if x > 0:
                    d = min(d, out[y + 1, x - 1] + slant)
            out[y, x] = d


@kernel
def accept_spread(
    u: F32, v: F32, min_distance: F32, distance: F32, accepted: U8, capacity: int
) -> int:
    """Take candidates in order where no taken or given point is within their distance.

    u, v, min_distance  (n,)    float32 [px of the map]
    distance            (h, w)  float32  distance to the given points; updated
    accepted            (n,)    uint8, out

    Returns how many were taken, at most `capacity`.
    """
    height, width = distance.shape
    count = 0
    for i in range(u.shape[0]):
        accepted[i] = 0
        x, y = int(u[i] + 0.5), int(v[i] + 0.5)
        if count >= capacity or not (0 <= x < width and 0 <= y < height):
            continue
        if distance[y, x] < min_distance[i]:
            continue
        accepted[i] = 1
        count += 1
        reach = math.ceil(min_distance[i]) + 4
        for yy in range(max(y - reach, 0), min(y + reach + 1, height)):
            for xx in range(max(x - reach, 0), min(x + reach + 1, width)):
                d = math.sqrt(float((xx - x) ** 2 + (yy - y) ** 2))
                distance[yy, xx] = min(distance[yy, xx], np.float32(d))
    return count
