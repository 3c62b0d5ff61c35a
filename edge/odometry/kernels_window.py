# SPDX-License-Identifier: Apache-2.0
"""Photometric residuals of the whole window: linearisation and sums.

Vector lanes are points. Points of one host lie together, padded to blocks of
BLOCK lanes; a padding lane has no active residual. Jacobians of the geometry
are taken at the first estimates (FEJ), image gradients at the current ones
(Engel et al. 2018, sec. 2.3).
"""

import math

import numpy as np

from edge.image.sampling import sample
from edge.kernel import kernel
from edge.types import F32, F64, I32, U8

BLOCK = 32
ZERO, ONE, TWO, HALF = np.float32(0.0), np.float32(1.0), np.float32(2.0), np.float32(0.5)
FAR = np.float32(1e-6)
# Rows of the point table.
U, V, IDEPTH, GOOD_VIEWS, GREY, WEIGHT = 0, 1, 2, 3, 4, 12
POINT_ROWS = 20
# The pattern of 8 pixels of Engel et al. 2018, fig. 3.
PATTERN_U = np.array([0, -1, 1, -2, 0, 2, -1, 0], np.float32)
PATTERN_V = np.array([-2, -1, -1, 0, 0, 0, 1, 2], np.float32)
PATTERN_CENTRE = 4
PATTERN_SIZE = 8
# States of a residual.
UNUSED, INLIER, OUTLIER, OUTSIDE = 0, 1, 2, 3
N_SUMS = 45
# Scratch rows: 0-17 Gram sums and flags, 18-31 geometry, 32-39 products, then these.
POINT_AT, HOST_AT, HD_AT, BD_AT, SCRATCH_ROWS = 40, 60, 68, 69, 70


@kernel
def sample_pattern(
    flat: F32,
    flat_mask: U8,
    width: int,
    height: int,
    intrinsics: F32,
    T: F32,
    gain: np.float32,
    offset: np.float32,
    gain_first: np.float32,
    host_first: np.float32,
    host_now: np.float32,
    huber: np.float32,
    scale2: np.float32,
    s: F32,
) -> None:
    """Add up the Gram sums of one block of points in one target, in scratch rows 0-16.

    A function of its own, since only what comes in as an argument is known not
    to overlap, and only then is the loop over points vectorised.
    """
    row, mask_row = np.int32(3 * width), np.int32(width)
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    ifx, ify = ONE / fx, ONE / fy
    u_max, v_max = np.float32(width - 2), np.float32(height - 2)
    r00, r01, r02, r10, r11, r12 = T[0], T[1], T[2], T[3], T[4], T[5]
    r20, r21, r22, t0, t1, t2 = T[6], T[7], T[8], T[9], T[10], T[11]
    for q in range(PATTERN_SIZE):
        pu, pv = PATTERN_U[q], PATTERN_V[q]
        for k in range(BLOCK):
            x = (s[(POINT_AT + U) * BLOCK + k] + pu - cx) * ifx
            y = (s[(POINT_AT + V) * BLOCK + k] + pv - cy) * ify
            idepth = s[(POINT_AT + IDEPTH) * BLOCK + k]
            z = r20 * x + r21 * y + r22 + t2 * idepth
            inv = ONE / (z if z > FAR else ONE)
            u = fx * (r00 * x + r01 * y + r02 + t0 * idepth) * inv + cx
            v = fy * (r10 * x + r11 * y + r12 + t1 * idepth) * inv + cy
            inside = (z > FAR) & (u > ONE) & (v > ONE) & (u < u_max) & (v < v_max)
            u = u if inside else ONE
            v = v if inside else ONE
            x0, y0 = np.int32(u), np.int32(v)
            valid = np.float32(flat_mask[y0 * mask_row + x0])
            s[16 * BLOCK + k] *= valid if inside else ZERO
            fu, fv = u - np.float32(x0), v - np.float32(y0)
            at = y0 * row + np.int32(3) * x0
            grey, gx, gy = sample(flat, at, row, fu, fv)
            colour = s[(POINT_AT + GREY + q) * BLOCK + k]
            r = grey - offset - gain * (colour - host_now)
            ja = -gain_first * (colour - host_first)
            g2 = gx * gx + gy * gy
            wt = HALF * (math.sqrt(scale2 / (scale2 + g2)) + s[(POINT_AT + WEIGHT + q) * BLOCK + k])
            size = abs(r)
            robust = ONE if size < huber else huber / size
            w2 = wt * wt
            w = w2 * robust
            s[15 * BLOCK + k] += w * r * r * (TWO - robust)
            s[0 * BLOCK + k] += w * gx * gx
            s[1 * BLOCK + k] += w * gx * gy
            s[2 * BLOCK + k] += w * gy * gy
            s[3 * BLOCK + k] += w * gx * ja
            s[4 * BLOCK + k] += w * gy * ja
            s[5 * BLOCK + k] -= w * gx
            s[6 * BLOCK + k] -= w * gy
            s[7 * BLOCK + k] += w * ja * ja
            s[8 * BLOCK + k] -= w * ja
            s[9 * BLOCK + k] += w
            wr = w * r
            s[10 * BLOCK + k] += wr * gx
            s[11 * BLOCK + k] += wr * gy
            s[12 * BLOCK + k] += wr * ja
            s[13 * BLOCK + k] -= wr
            s[14 * BLOCK + k] += wr * r


@kernel
def linearise(
    images: F32,
    mask: U8,
    slots: I32,
    block_host: I32,
    points: F32,
    intrinsics: F32,
    warp: F32,
    warp_first: F32,
    affine: F32,
    offset_first: F32,
    energy_limit: F32,
    huber: np.float32,
    gradient_scale: np.float32,
    adjoint: F32,
    active: U8,
    scratch: F32,
    state: U8,
    energy: F32,
    sums: F64,
    W: F32,
    Hd: F32,
    bd: F32,
) -> float:
    """Linearise every active residual and sum up the normal equations.

    images       (slots, h, w, 3)  float32  level 0 of the keyframes
    mask         (h, w)    uint8
    slots        (f,)      int32    where each window frame lies in `images`
    block_host   (n / BLOCK,) int32 host frame of each block
    points       (20, n)   float32  u, v, inverse depth, good views, grey (8), weight (8)
    intrinsics   (4,)      float32
    warp         (f, f, 12) float32 [host, target]: R, t at the current state
    warp_first   (f, f, 12) float32 the same at the first estimates
    affine       (f, f, 3) float32  [host, target]: gain, target offset, gain at first estimate
    offset_first (f,)      float32  host brightness offset at its first estimate, and
                                    current one in row 1: (2, f)
    energy_limit (f,)      float32  beyond which a residual is an outlier
    adjoint      (f, f, 36) float32 -Ad(T_target_host) at the first estimates
    active       (f, n)    uint8    1 where the residual takes part
    state, energy (f, n)   uint8, float32, out
    sums         (f, f, 45) float64, out: per pair: 36 of H, 8 of b, energy (8x8 relative)
    W            (8 f, n)  float32, out: Jacobian products of frames and depths
    Hd, bd       (n,)      float32, out

    Returns the energy, outliers counted at their limit.
    """
    n_frames = slots.shape[0]
    height, width = mask.shape
    flat_mask = mask.reshape(-1)
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    ifx, ify = ONE / fx, ONE / fy
    scale2 = gradient_scale * gradient_scale
    sums[:] = 0.0
    W[:] = ZERO
    Hd[:] = ZERO
    bd[:] = ZERO
    s = scratch
    total = 0.0
    for block in range(block_host.shape[0]):
        host = block_host[block]
        start = block * BLOCK
        # Copies at constant offsets: loads behind a variable offset are not vectorised.
        for q in range(POINT_ROWS):
            for k in range(BLOCK):
                s[(POINT_AT + q) * BLOCK + k] = points[q, start + k]
        for q in range(HOST_AT, SCRATCH_ROWS):
            for k in range(BLOCK):
                s[q * BLOCK + k] = ZERO
        for target in range(n_frames):
            if target == host:
                continue
            any_active = False
            for k in range(BLOCK):
                any_active |= active[target, start + k] != 0
            if not any_active:
                for k in range(BLOCK):
                    state[target, start + k] = UNUSED
                continue
            gain, offset = affine[host, target, 0], affine[host, target, 1]
            gain_first = affine[host, target, 2]
            host_first, host_now = offset_first[0, host], offset_first[1, host]
            limit = max(energy_limit[host], energy_limit[target])
            for q in range(17):
                for k in range(BLOCK):
                    s[q * BLOCK + k] = ZERO
            for k in range(BLOCK):
                s[16 * BLOCK + k] = np.float32(active[target, start + k])
            sample_pattern(
                images[slots[target]].reshape(-1),
                flat_mask,
                width,
                height,
                intrinsics,
                warp[host, target],
                gain,
                offset,
                gain_first,
                host_first,
                host_now,
                huber,
                scale2,
                s,
            )
            # Which residuals count; where not, their Gram sums become zero.
            block_energy = ZERO
            for k in range(BLOCK):
                p = start + k
                was = active[target, p] != 0
                visible = s[16 * BLOCK + k] > HALF
                good = (
                    visible
                    & (s[15 * BLOCK + k] <= limit)
                    & (s[0 * BLOCK + k] + s[2 * BLOCK + k] > TWO)
                )
                keep = ONE if good else ZERO
                value = s[15 * BLOCK + k] if good else limit
                block_energy += value if visible else ZERO
                energy[target, p] = s[15 * BLOCK + k] if visible else limit
                seen = INLIER if good else OUTLIER
                seen = seen if visible else OUTSIDE
                state[target, p] = seen if was else UNUSED
                s[17 * BLOCK + k] = keep
            total += float(block_energy)
            for q in range(15):
                for k in range(BLOCK):
                    s[q * BLOCK + k] = s[q * BLOCK + k] if s[17 * BLOCK + k] > HALF else ZERO
            # Geometry at the first estimates: rows 18-23 are du/dxi, 24-29 dv/dxi, 30-31 depth.
            r00, r01 = warp_first[host, target, 0], warp_first[host, target, 1]
            r02, r10 = warp_first[host, target, 2], warp_first[host, target, 3]
            r11, r12 = warp_first[host, target, 4], warp_first[host, target, 5]
            r20, r21 = warp_first[host, target, 6], warp_first[host, target, 7]
            r22, t0 = warp_first[host, target, 8], warp_first[host, target, 9]
            t1, t2 = warp_first[host, target, 10], warp_first[host, target, 11]
            for k in range(BLOCK):
                x = (s[(POINT_AT + U) * BLOCK + k] - cx) * ifx
                y = (s[(POINT_AT + V) * BLOCK + k] - cy) * ify
                idepth = s[(POINT_AT + IDEPTH) * BLOCK + k]
                z = r20 * x + r21 * y + r22 + t2 * idepth
                inv = ONE / (z if z > FAR else ONE)
                X = (r00 * x + r01 * y + r02 + t0 * idepth) * inv
                Y = (r10 * x + r11 * y + r12 + t1 * idepth) * inv
                nid = idepth * inv
                s[18 * BLOCK + k] = fx * nid
                s[19 * BLOCK + k] = ZERO
                s[20 * BLOCK + k] = -fx * X * nid
                s[21 * BLOCK + k] = -fx * X * Y
                s[22 * BLOCK + k] = fx * (ONE + X * X)
                s[23 * BLOCK + k] = -fx * Y
                s[24 * BLOCK + k] = ZERO
                s[25 * BLOCK + k] = fy * nid
                s[26 * BLOCK + k] = -fy * Y * nid
                s[27 * BLOCK + k] = -fy * (ONE + Y * Y)
                s[28 * BLOCK + k] = fy * X * Y
                s[29 * BLOCK + k] = fy * X
                s[30 * BLOCK + k] = fx * inv * (t0 - t2 * X)
                s[31 * BLOCK + k] = fy * inv * (t1 - t2 * Y)
            # Sums of the pair, upper triangle row by row: xi (6), a, b.
            out = 0
            for i in range(6):
                for j in range(i, 6):
                    total_ij = ZERO
                    for k in range(BLOCK):
                        total_ij += s[(18 + i) * BLOCK + k] * (
                            s[0 * BLOCK + k] * s[(18 + j) * BLOCK + k]
                            + s[1 * BLOCK + k] * s[(24 + j) * BLOCK + k]
                        ) + s[(24 + i) * BLOCK + k] * (
                            s[1 * BLOCK + k] * s[(18 + j) * BLOCK + k]
                            + s[2 * BLOCK + k] * s[(24 + j) * BLOCK + k]
                        )
                    sums[host, target, out] += total_ij
                    out += 1
                total_a, total_b = ZERO, ZERO
                for k in range(BLOCK):
                    total_a += (
                        s[(18 + i) * BLOCK + k] * s[3 * BLOCK + k]
                        + s[(24 + i) * BLOCK + k] * s[4 * BLOCK + k]
                    )
                    total_b += (
                        s[(18 + i) * BLOCK + k] * s[5 * BLOCK + k]
                        + s[(24 + i) * BLOCK + k] * s[6 * BLOCK + k]
                    )
                sums[host, target, out] += total_a
                sums[host, target, out + 1] += total_b
                out += 2
                total_r = ZERO
                for k in range(BLOCK):
                    total_r += (
                        s[(18 + i) * BLOCK + k] * s[10 * BLOCK + k]
                        + s[(24 + i) * BLOCK + k] * s[11 * BLOCK + k]
                    )
                sums[host, target, 36 + i] += total_r
            for q in range(6):
                total_q = ZERO
                for k in range(BLOCK):
                    total_q += s[(7 + q if q < 3 else 9 + q) * BLOCK + k]
                at_sum = (33, 34, 35, 42, 43, 44)[q]
                sums[host, target, at_sum] += total_q
            # Depth part: rows 32-39 are the products with xi, a, b.
            for k in range(BLOCK):
                du, dv = s[30 * BLOCK + k], s[31 * BLOCK + k]
                gu = s[0 * BLOCK + k] * du + s[1 * BLOCK + k] * dv
                gv = s[1 * BLOCK + k] * du + s[2 * BLOCK + k] * dv
                s[HD_AT * BLOCK + k] += du * gu + dv * gv
                s[BD_AT * BLOCK + k] += du * s[10 * BLOCK + k] + dv * s[11 * BLOCK + k]
                s[38 * BLOCK + k] = s[3 * BLOCK + k] * du + s[4 * BLOCK + k] * dv
                s[39 * BLOCK + k] = s[5 * BLOCK + k] * du + s[6 * BLOCK + k] * dv
                s[(HOST_AT + 6) * BLOCK + k] -= s[38 * BLOCK + k]
                s[(HOST_AT + 7) * BLOCK + k] -= gain_first * s[39 * BLOCK + k]
                s[14 * BLOCK + k], s[15 * BLOCK + k] = gu, gv
            for i in range(6):
                for k in range(BLOCK):
                    s[(32 + i) * BLOCK + k] = (
                        s[(18 + i) * BLOCK + k] * s[14 * BLOCK + k]
                        + s[(24 + i) * BLOCK + k] * s[15 * BLOCK + k]
                    )
            for i in range(6):
                a0, a1 = adjoint[host, target, i], adjoint[host, target, 6 + i]
                a2, a3 = adjoint[host, target, 12 + i], adjoint[host, target, 18 + i]
                a4, a5 = adjoint[host, target, 24 + i], adjoint[host, target, 30 + i]
                for k in range(BLOCK):
                    s[(HOST_AT + i) * BLOCK + k] += (
                        a0 * s[32 * BLOCK + k]
                        + a1 * s[33 * BLOCK + k]
                        + a2 * s[34 * BLOCK + k]
                        + a3 * s[35 * BLOCK + k]
                        + a4 * s[36 * BLOCK + k]
                        + a5 * s[37 * BLOCK + k]
                    )
            for i in range(8):
                for k in range(BLOCK):
                    W[8 * target + i, start + k] = s[(32 + i) * BLOCK + k]
        for i in range(8):
            for k in range(BLOCK):
                W[8 * host + i, start + k] = s[(HOST_AT + i) * BLOCK + k]
        for k in range(BLOCK):
            Hd[start + k] = s[HD_AT * BLOCK + k]
            bd[start + k] = s[BD_AT * BLOCK + k]
    return total
