# SPDX-License-Identifier: Apache-2.0
"""Candidate points that the search has found: refinement in the whole window."""

import math

import numpy as np

from edge.image.sampling import sample
from edge.kernel import kernel
from edge.odometry.kernels_trace import HIGH, LIMIT, LOW
from edge.odometry.kernels_window import (
    GREY,
    IDEPTH,
    PATTERN_SIZE,
    PATTERN_U,
    PATTERN_V,
    WEIGHT,
    U,
    V,
)
from edge.types import F32, I32, U8

ZERO, ONE, TWO, HALF = np.float32(0.0), np.float32(1.0), np.float32(2.0), np.float32(0.5)
FAR = np.float32(1e-6)
BIG = np.float32(1e8)


@kernel
def refine_inverse_depths(
    images: F32,
    mask: U8,
    slots: I32,
    hosts: I32,
    table: F32,
    intrinsics: F32,
    warp: F32,
    affine: F32,
    host_offset: F32,
    huber: np.float32,
    gradient_scale: np.float32,
    min_good: int,
    ok: U8,
    good: U8,
) -> int:
    """Gauss-Newton on the inverse depth of candidates, against all other window frames.

    images, mask, slots, warp, affine   as in `kernels_linearise.linearise`
    hosts        (n,)     int32
    table        (30, n)  float32  rows LOW, HIGH give the start; IDEPTH is written
    host_offset  (f,)     float32
    ok           (n,)     uint8, out: 1 where the point may become active
    good         (f, n)   uint8, out: 1 where its residual in that frame is an inlier

    Returns how many are ok.
    """
    n_frames = slots.shape[0]
    height, width = mask.shape
    flat, flat_mask = images.reshape(-1), mask.reshape(-1)
    row = 3 * width
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    u_max, v_max = np.float32(width - 2), np.float32(height - 2)
    scale2 = gradient_scale * gradient_scale
    trial_good = np.zeros(n_frames, np.uint8)
    n_ok = 0
    for i in range(table.shape[1]):
        host = hosts[i]
        ok[i] = 0
        best = HALF * (table[LOW, i] + table[HIGH, i])
        trial = best
        best_energy, damping = BIG * BIG, np.float32(0.1)
        H_best = ZERO
        for _ in range(5):
            H, b, energy = ZERO, ZERO, ZERO
            for target in range(n_frames):
                trial_good[target] = 0
                if target == host:
                    continue
                base = np.int64(slots[target]) * height * row
                gain, offset = affine[host, target, 0], affine[host, target, 1]
                Hr, br, er, texture = ZERO, ZERO, ZERO, ZERO
                visible = True
                for q in range(PATTERN_SIZE):
                    x = (table[U, i] + PATTERN_U[q] - cx) / fx
                    y = (table[V, i] + PATTERN_V[q] - cy) / fy
                    z = (
                        warp[host, target, 6] * x
                        + warp[host, target, 7] * y
                        + warp[host, target, 8]
                        + warp[host, target, 11] * trial
                    )
                    inv = ONE / (z if z > FAR else ONE)
                    X = inv * (
                        warp[host, target, 0] * x
                        + warp[host, target, 1] * y
                        + warp[host, target, 2]
                        + warp[host, target, 9] * trial
                    )
                    Y = inv * (
                        warp[host, target, 3] * x
                        + warp[host, target, 4] * y
                        + warp[host, target, 5]
                        + warp[host, target, 10] * trial
                    )
                    u, v = fx * X + cx, fy * Y + cy
                    if not (z > FAR and u > ONE and v > ONE and u < u_max and v < v_max):
                        visible = False
                        break
                    x0, y0 = int(u), int(v)
                    if flat_mask[y0 * width + x0] == 0:
                        visible = False
                        break
                    fu, fv = u - np.float32(x0), v - np.float32(y0)
                    at = base + y0 * row + 3 * x0
                    grey, gx, gy = sample(flat, at, row, fu, fv)
                    r = grey - offset - gain * (table[GREY + q, i] - host_offset[host])
                    g2 = gx * gx + gy * gy
                    wt = HALF * (np.sqrt(scale2 / (scale2 + g2)) + table[WEIGHT + q, i])
                    size = abs(r)
                    robust = ONE if size < huber else huber / size
                    w = wt * wt * robust
                    slope = inv * (
                        gx * fx * (warp[host, target, 9] - warp[host, target, 11] * X)
                        + gy * fy * (warp[host, target, 10] - warp[host, target, 11] * Y)
                    )
                    er += w * r * r * (TWO - robust)
                    Hr += w * slope * slope
                    br += w * slope * r
                    texture += w * g2
                if not visible:
                    continue
                if er > table[LIMIT, i] or texture < TWO:
                    energy += table[LIMIT, i]
                    continue
                trial_good[target] = 1
                energy += er
                H += Hr
                b += br
            if energy < best_energy:
                best_energy, best, H_best = energy, trial, H
                for target in range(n_frames):
                    good[target, i] = trial_good[target]
                damping *= HALF
                step = -b / max(H * (ONE + damping), FAR)
                trial = best + step
                if abs(step) < np.float32(1e-4) * abs(best):
                    break
            else:
                damping *= np.float32(5.0)
                trial = HALF * (trial + best)
        count = 0
        for target in range(n_frames):
            count += good[target, i]
        table[IDEPTH, i] = best
        # Too little slope along the line in all frames: its depth is not known.
        if (
            count >= min_good
            and math.isfinite(best)
            and best > ZERO
            and H_best * best * best > 50.0
        ):
            ok[i] = 1
            n_ok += 1
    return n_ok
