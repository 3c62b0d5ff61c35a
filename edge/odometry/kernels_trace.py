# SPDX-License-Identifier: Apache-2.0
"""Candidate points: search along epipolar lines.

A candidate table is (CANDIDATE_ROWS, n) float32, one column a point.
"""

import math

import numpy as np

from edge.image.sampling import sample
from edge.kernel import inline_kernel, kernel
from edge.odometry.kernels_epipolar import (
    BAD,
    FAR,
    FLAT,
    FRESH,
    GOOD,
    ONE,
    OUT,
    SKIPPED,
    ZERO,
    Two,
    error_px_of,
    interval_of,
    line_of,
    turn_pattern,
)
from edge.odometry.kernels_window import (
    GREY,
    PATTERN_SIZE,
    PATTERN_U,
    PATTERN_V,
    WEIGHT,
    U,
    V,
)
from edge.types import F32, U8

TWO, HALF = np.float32(2.0), np.float32(0.5)
BIG = np.float32(1e8)
# Rows 0-19 are those of a point (u, v, inverse depth, -, grey 8, weight 8), then:
LOW, HIGH, STATUS, QUALITY, INTERVAL_PX = 20, 21, 22, 23, 24
GXX, GXY, GYY, LIMIT, CELL = 25, 26, 27, 28, 29
CANDIDATE_ROWS = 30
MAX_STEPS = 128


@kernel
def describe(level: F32, gradient_scale: np.float32, outlier_grey: np.float32, table: F32) -> None:
    """Fill grey, weight, gradient and search limits of candidates at integer (u, v).

    level  (h, w, 3)  float32  of the host
    table  (30, n)    float32  rows U, V, CELL are given; the others are written
    """
    for i in range(table.shape[1]):
        u, v = int(table[U, i]), int(table[V, i])
        gxx = gxy = gyy = ZERO
        for q in range(PATTERN_SIZE):
            x, y = u + int(PATTERN_U[q]), v + int(PATTERN_V[q])
            gx, gy = level[y, x, 1], level[y, x, 2]
            gxx += gx * gx
            gxy += gx * gy
            gyy += gy * gy
            table[GREY + q, i] = level[y, x, 0]
            table[WEIGHT + q, i] = math.sqrt(
                gradient_scale
                * gradient_scale
                / (gradient_scale * gradient_scale + gx * gx + gy * gy)
            )
        table[GXX, i], table[GXY, i], table[GYY, i] = gxx, gxy, gyy
        table[LOW, i], table[HIGH, i] = ZERO, np.float32(np.nan)
        table[STATUS, i] = FRESH
        table[QUALITY, i] = np.float32(1e4)
        table[INTERVAL_PX, i] = ZERO
        table[LIMIT, i] = np.float32(PATTERN_SIZE) * outlier_grey * outlier_grey


@kernel
def trace(
    image: F32,
    mask: U8,
    intrinsics: F32,
    warp: F32,
    affine: F32,
    huber: np.float32,
    max_search_px: np.float32,
    table: F32,
) -> int:
    """Narrow the inverse depth interval of every candidate of one host in a new frame.

    image       (h, w, 3)  float32
    intrinsics  (4,)       float32
    warp        (12,)      float32  R (9) and t of T_target_host
    affine      (2,)       float32  gain and offset of the target over the host
    table       (30, n)    float32  in and out

    Returns how many candidates hold a good interval afterwards. Search with
    unit steps, then Gauss-Newton along the line (Engel et al. 2018, sec. 2.4);
    the new interval is the match's uncertainty, from the angle between the
    gradient and the line.
    """
    height, width = mask.shape
    flat, flat_mask = image.reshape(-1), mask.reshape(-1)
    size = (width, height)
    grey = np.empty(PATTERN_SIZE, np.float32)
    pattern = np.empty((2, PATTERN_SIZE), np.float32)
    energies = np.empty(MAX_STEPS, np.float32)
    n_good = 0
    for i in range(table.shape[1]):
        before = int(table[STATUS, i])
        if before == OUT:
            continue
        x = (table[U, i] - intrinsics[2]) / intrinsics[0]
        y = (table[V, i] - intrinsics[3]) / intrinsics[1]
        ray = (
            warp[0] * x + warp[1] * y + warp[2],
            warp[3] * x + warp[4] * y + warp[5],
            warp[6] * x + warp[7] * y + warp[8],
        )
        status, start, along, length = line_of(
            table[LOW, i], table[HIGH, i], ray, warp, intrinsics, size, max_search_px
        )
        error_px = error_px_of(table[GXX, i], table[GXY, i], table[GYY, i], along)
        if status == GOOD and error_px * TWO > length and table[HIGH, i] == table[HIGH, i]:
            status = FLAT
        if status != GOOD:
            table[STATUS, i] = before if status == SKIPPED and before != FRESH else status
            if status != OUT:
                table[INTERVAL_PX, i] = length
            n_good += 1 if table[STATUS, i] == GOOD else 0
            continue
        turn_pattern(ray, table[LOW, i], warp, pattern)
        for q in range(PATTERN_SIZE):
            grey[q] = affine[0] * table[GREY + q, i] + affine[1]
        steps = min(int(length + np.float32(1.9999)), MAX_STEPS)
        best, quality = _search(flat, size, start, along, steps, pattern, grey, huber, energies)
        if steps > 10 or quality < table[QUALITY, i]:
            table[QUALITY, i] = quality
        start = start[0] + along[0] * np.float32(best), start[1] + along[1] * np.float32(best)
        u, v, energy = _refine(flat, size, start, along, pattern, grey, huber, table, i)

        column, row = int(u), int(v)
        seen = 0 <= column < width and 0 <= row < height and flat_mask[row * width + column] > 0
        if not seen or not energy < table[LIMIT, i] * np.float32(1.2):
            table[INTERVAL_PX, i] = ZERO
            table[STATUS, i] = OUT if before == BAD or not seen else BAD
            continue
        low, high = interval_of(u, v, along, min(error_px, np.float32(10.0)), ray, warp, intrinsics)
        if not (math.isfinite(low) and math.isfinite(high)) or high <= ZERO:
            table[STATUS, i] = OUT if before == BAD else BAD
            continue
        table[LOW, i], table[HIGH, i] = max(low, ZERO), high
        table[INTERVAL_PX, i] = TWO * min(error_px, np.float32(10.0))
        table[STATUS, i] = GOOD
        n_good += 1
    return n_good


@inline_kernel
def _search(
    flat: F32,
    size: tuple[int, int],
    start: Two,
    along: Two,
    steps: int,
    pattern: F32,
    grey: F32,
    huber: np.float32,
    energies: F32,
) -> tuple[int, np.float32]:
    """The best of `steps` unit steps, and how many times worse the best one away from it is."""
    row = np.int32(3 * size[0])
    u_max, v_max = np.float32(size[0] - 5), np.float32(size[1] - 5)
    for k in range(steps):
        energies[k] = ZERO
    for q in range(PATTERN_SIZE):
        for k in range(steps):
            u = start[0] + along[0] * np.float32(k) + pattern[0, q]
            v = start[1] + along[1] * np.float32(k) + pattern[1, q]
            inside = (u > ONE) & (v > ONE) & (u < u_max) & (v < v_max)
            u = u if inside else ONE
            v = v if inside else ONE
            x0, y0 = np.int32(u), np.int32(v)
            fu, fv = u - np.float32(x0), v - np.float32(y0)
            at = y0 * row + np.int32(3) * x0
            w11 = fu * fv
            value = (
                (ONE - fu - fv + w11) * flat[at]
                + (fu - w11) * flat[at + 3]
                + (fv - w11) * flat[at + row]
                + w11 * flat[at + row + 3]
            )
            r = abs(value - grey[q])
            e = r * r if r < huber else huber * (TWO * r - huber)
            energies[k] += e if inside else BIG
    best = 0
    for k in range(1, steps):
        if energies[k] < energies[best]:
            best = k
    second = BIG
    for k in range(steps):
        if (k < best - 2 or k > best + 2) and energies[k] < second:
            second = energies[k]
    return best, second / max(energies[best], FAR)


@inline_kernel
def _refine(
    flat: F32,
    size: tuple[int, int],
    start: Two,
    along: Two,
    pattern: F32,
    grey: F32,
    huber: np.float32,
    table: F32,
    i: int,
) -> tuple[np.float32, np.float32, np.float32]:
    """Gauss-Newton along the line: pixel and energy of the best match."""
    row = np.int32(3 * size[0])
    u_max, v_max = np.float32(size[0] - 5), np.float32(size[1] - 5)
    du, dv = along
    u_best, v_best = start
    u_try, v_try = start
    shrink, last_step = ONE, ZERO
    best_energy = BIG
    for _ in range(4):
        H, b, energy = ZERO, ZERO, ZERO
        for q in range(PATTERN_SIZE):
            u, v = u_try + pattern[0, q], v_try + pattern[1, q]
            inside = (u > ONE) & (v > ONE) & (u < u_max) & (v < v_max)
            u = u if inside else ONE
            v = v if inside else ONE
            x0, y0 = np.int32(u), np.int32(v)
            at = y0 * row + np.int32(3) * x0
            value, gx, gy = sample(flat, at, row, u - np.float32(x0), v - np.float32(y0))
            r = value - grey[q]
            robust = ONE if abs(r) < huber else huber / abs(r)
            slope = du * gx + dv * gy
            H += robust * slope * slope
            b += robust * r * slope
            wt = table[WEIGHT + q, i]
            energy += (wt * wt * robust * r * r * (TWO - robust)) if inside else BIG
        if energy > best_energy:
            # Too far: half of the last step back from the best.
            shrink *= HALF
            last_step *= HALF
            u_try, v_try = u_best + last_step * du, v_best + last_step * dv
            continue
        best_energy, u_best, v_best = energy, u_try, v_try
        last_step = min(max(-shrink * b / max(H, FAR), -HALF), HALF)
        if abs(last_step) < np.float32(0.05):
            break
        u_try, v_try = u_best + last_step * du, v_best + last_step * dv
    return u_best, v_best, best_energy
