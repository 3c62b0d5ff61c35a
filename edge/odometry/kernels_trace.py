# SPDX-License-Identifier: Apache-2.0
"""Candidate points: search along epipolar lines.

A candidate table is (CANDIDATE_ROWS, n) float32, one column a point.
"""

import math

import numpy as np

from edge.image.sampling import sample
from edge.kernel import kernel
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

ZERO, ONE, TWO, HALF = np.float32(0.0), np.float32(1.0), np.float32(2.0), np.float32(0.5)
FAR = np.float32(1e-6)
BIG = np.float32(1e8)
# Rows 0-19 are those of a point (u, v, inverse depth, -, grey 8, weight 8), then:
LOW, HIGH, STATUS, QUALITY, INTERVAL_PX = 20, 21, 22, 23, 24
GXX, GXY, GYY, LIMIT, CELL = 25, 26, 27, 28, 29
CANDIDATE_ROWS = 30
# Statuses.
FRESH, GOOD, OUT, BAD, SKIPPED, FLAT = 0, 1, 2, 3, 4, 5
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
    row = 3 * width
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    gain, offset = affine[0], affine[1]
    u_max, v_max = np.float32(width - 5), np.float32(height - 5)
    edge = np.float32(4.0)
    energies = np.empty(MAX_STEPS, np.float32)
    pu, pv = np.empty(PATTERN_SIZE, np.float32), np.empty(PATTERN_SIZE, np.float32)
    n_good = 0
    for i in range(table.shape[1]):
        status = int(table[STATUS, i])
        if status == OUT:
            continue
        x = (table[U, i] - cx) / fx
        y = (table[V, i] - cy) / fy
        ax = warp[0] * x + warp[1] * y + warp[2]
        ay = warp[3] * x + warp[4] * y + warp[5]
        az = warp[6] * x + warp[7] * y + warp[8]
        low, high = table[LOW, i], table[HIGH, i]
        bounded = high == high
        z_low = az + warp[11] * low
        if z_low < np.float32(0.05):
            table[STATUS, i] = OUT
            continue
        u_low = fx * (ax + warp[9] * low) / z_low + cx
        v_low = fy * (ay + warp[10] * low) / z_low + cy
        if not (u_low > edge and v_low > edge and u_low < u_max and v_low < v_max):
            table[STATUS, i] = OUT
            continue
        if bounded:
            z_high = az + warp[11] * high
            if z_high < np.float32(0.05):
                table[STATUS, i] = OUT
                continue
            u_high = fx * (ax + warp[9] * high) / z_high + cx
            v_high = fy * (ay + warp[10] * high) / z_high + cy
            if not (u_high > edge and v_high > edge and u_high < u_max and v_high < v_max):
                table[STATUS, i] = OUT
                continue
            du, dv = u_high - u_low, v_high - v_low
            length = np.sqrt(du * du + dv * dv)
            if length < np.float32(1.5):
                table[STATUS, i] = SKIPPED if status == FRESH else status
                table[INTERVAL_PX, i] = length
                n_good += 1 if table[STATUS, i] == GOOD else 0
                continue
            du, dv = du / length, dv / length
            length = length if length < max_search_px else max_search_px
        else:
            # Direction of the line at `low`; exact for any step along it.
            du = fx * (warp[9] * az - warp[11] * ax)
            dv = fy * (warp[10] * az - warp[11] * ay)
            norm = math.sqrt(du * du + dv * dv)
            if not norm > np.float32(1e-12):
                table[STATUS, i] = SKIPPED if status == FRESH else status
                continue
            du, dv = du / norm, dv / norm
            length = max_search_px
            u_end, v_end = u_low + du * length, v_low + dv * length
            if not (u_end > edge and v_end > edge and u_end < u_max and v_end < v_max):
                table[STATUS, i] = OUT
                continue
        # How far the pattern turns and grows between the frames.
        scale = ONE / z_low if z_low > np.float32(0.1) else ONE
        m00 = (warp[0] - warp[6] * ax * scale) * scale
        m01 = (warp[1] - warp[7] * ax * scale) * scale
        m10 = (warp[3] - warp[6] * ay * scale) * scale
        m11 = (warp[4] - warp[7] * ay * scale) * scale
        if not (np.float32(0.6) < az and az < np.float32(1.7)):
            table[STATUS, i] = OUT
            continue
        along = du * (du * table[GXX, i] + dv * table[GXY, i]) + dv * (
            du * table[GXY, i] + dv * table[GYY, i]
        )
        across = dv * (dv * table[GXX, i] - du * table[GXY, i]) + du * (
            du * table[GYY, i] - dv * table[GXY, i]
        )
        error_px = np.float32(0.2) + np.float32(0.2) * (along + across) / max(along, FAR)
        if error_px * TWO > length and bounded:
            table[STATUS, i] = FLAT
            table[INTERVAL_PX, i] = length
            continue
        error_px = min(error_px, np.float32(10.0))
        for q in range(PATTERN_SIZE):
            pu[q] = m00 * PATTERN_U[q] + m01 * PATTERN_V[q]
            pv[q] = m10 * PATTERN_U[q] + m11 * PATTERN_V[q]

        steps = min(int(length + np.float32(1.9999)), MAX_STEPS)
        for k in range(steps):
            energies[k] = ZERO
        for q in range(PATTERN_SIZE):
            colour = gain * table[GREY + q, i] + offset
            for k in range(steps):
                u = u_low + du * np.float32(k) + pu[q]
                v = v_low + dv * np.float32(k) + pv[q]
                inside = (u > ONE) & (v > ONE) & (u < u_max) & (v < v_max)
                u = u if inside else ONE
                v = v if inside else ONE
                x0, y0 = np.int32(u), np.int32(v)
                fu, fv = u - np.float32(x0), v - np.float32(y0)
                at = y0 * np.int32(row) + np.int32(3) * x0
                w11 = fu * fv
                grey = (
                    (ONE - fu - fv + w11) * flat[at]
                    + (fu - w11) * flat[at + 3]
                    + (fv - w11) * flat[at + row]
                    + w11 * flat[at + row + 3]
                )
                r = abs(grey - colour)
                e = r * r if r < huber else huber * (TWO * r - huber)
                energies[k] += e if inside else BIG
        best, best_energy = 0, energies[0]
        for k in range(1, steps):
            if energies[k] < best_energy:
                best, best_energy = k, energies[k]
        second = BIG
        for k in range(steps):
            if (k < best - 2 or k > best + 2) and energies[k] < second:
                second = energies[k]
        quality = second / max(best_energy, FAR)
        if steps > 10 or quality < table[QUALITY, i]:
            table[QUALITY, i] = quality

        # Gauss-Newton along the line, in pixels.
        u_best, v_best = u_low + du * np.float32(best), v_low + dv * np.float32(best)
        u_try, v_try = u_best, v_best
        shrink, last_step = ONE, ZERO
        best_energy = BIG
        for _ in range(4):
            H, b, e_sum = ZERO, ZERO, ZERO
            for q in range(PATTERN_SIZE):
                u, v = u_try + pu[q], v_try + pv[q]
                inside = (u > ONE) & (v > ONE) & (u < u_max) & (v < v_max)
                u = u if inside else ONE
                v = v if inside else ONE
                x0, y0 = np.int32(u), np.int32(v)
                fu, fv = u - np.float32(x0), v - np.float32(y0)
                at = y0 * np.int32(row) + np.int32(3) * x0
                grey, gx, gy = sample(flat, at, row, fu, fv)
                r = grey - gain * table[GREY + q, i] - offset
                size = abs(r)
                robust = ONE if size < huber else huber / size
                slope = du * gx + dv * gy
                H += robust * slope * slope
                b += robust * r * slope
                wt = table[WEIGHT + q, i]
                e_sum += (wt * wt * robust * r * r * (TWO - robust)) if inside else BIG
            if e_sum > best_energy:
                # Too far: half of the last step back from the best.
                shrink *= HALF
                last_step *= HALF
                u_try, v_try = u_best + last_step * du, v_best + last_step * dv
                continue
            best_energy, u_best, v_best = e_sum, u_try, v_try
            step = -shrink * b / max(H, FAR)
            step = min(max(step, -HALF), HALF)
            last_step = step
            if abs(step) < np.float32(0.05):
                break
            u_try, v_try = u_best + step * du, v_best + step * dv

        xb, yb = int(u_best), int(v_best)
        seen = 0 <= xb < width and 0 <= yb < height and flat_mask[yb * width + xb] > 0
        if not seen or not best_energy < table[LIMIT, i] * np.float32(1.2):
            table[INTERVAL_PX, i] = ZERO
            table[STATUS, i] = OUT if status == BAD or not seen else BAD
            continue
        # The match's interval [px] as inverse depths, by the longer image axis.
        u0, u1 = u_best - error_px * du, u_best + error_px * du
        v0, v1 = v_best - error_px * dv, v_best + error_px * dv
        if du * du > dv * dv:
            p0, p1 = (u0 - cx) / fx, (u1 - cx) / fx
            d0 = (p0 * az - ax) / (warp[9] - warp[11] * p0)
            d1 = (p1 * az - ax) / (warp[9] - warp[11] * p1)
        else:
            p0, p1 = (v0 - cy) / fy, (v1 - cy) / fy
            d0 = (p0 * az - ay) / (warp[10] - warp[11] * p0)
            d1 = (p1 * az - ay) / (warp[10] - warp[11] * p1)
        if d0 > d1:
            d0, d1 = d1, d0
        if not (math.isfinite(d0) and math.isfinite(d1)) or d1 <= ZERO:
            table[STATUS, i] = OUT if status == BAD else BAD
            continue
        table[LOW, i], table[HIGH, i] = max(d0, ZERO), d1
        table[INTERVAL_PX, i] = TWO * error_px
        table[STATUS, i] = GOOD
        n_good += 1
    return n_good
