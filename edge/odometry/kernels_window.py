# SPDX-License-Identifier: Apache-2.0
"""Photometric residuals of one block of points in one image: what `kernels_linearise` sums up.

Vector lanes are points. Points of one host lie together, padded to blocks of
BLOCK lanes; a padding lane has no active residual. Jacobians of the geometry
are taken at the first estimates (FEJ), image gradients at the current ones
(Engel et al. 2018, sec. 2.3). Scratch `s` holds rows of BLOCK lanes.
"""

import math

import numpy as np

from edge.image.sampling import sample
from edge.kernel import kernel
from edge.types import F32, F64, U8

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
def derive_geometry(intrinsics: F32, T: F32, s: F32) -> None:
    """Derivatives of one block's places by pose and depth, in scratch rows 18-31.

    Rows 18-23 are du/dxi, 24-29 dv/dxi, 30-31 those by inverse depth, all at the
    first estimates `T` (12,): R row by row, t.
    """
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    ifx, ify = ONE / fx, ONE / fy
    r00, r01 = T[0], T[1]
    r02, r10 = T[2], T[3]
    r11, r12 = T[4], T[5]
    r20, r21 = T[6], T[7]
    r22, t0 = T[8], T[9]
    t1, t2 = T[10], T[11]
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


@kernel
def add_pair(s: F32, sums: F64) -> None:
    """Add one block to the sums (45,) of its pair: xi (6), a, b, upper triangle row by row."""
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
            sums[out] += total_ij
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
        sums[out] += total_a
        sums[out + 1] += total_b
        out += 2
        total_r = ZERO
        for k in range(BLOCK):
            total_r += (
                s[(18 + i) * BLOCK + k] * s[10 * BLOCK + k]
                + s[(24 + i) * BLOCK + k] * s[11 * BLOCK + k]
            )
        sums[36 + i] += total_r
    for q in range(6):
        total_q = ZERO
        for k in range(BLOCK):
            total_q += s[(7 + q if q < 3 else 9 + q) * BLOCK + k]
        at_sum = (33, 34, 35, 42, 43, 44)[q]
        sums[at_sum] += total_q


@kernel
def add_depths(adjoint: F32, gain_first: np.float32, s: F32) -> None:
    """Products of one block's depths with xi, a, b, in scratch rows 32-39, and the host's part.

    `adjoint` (36,) takes a step of the target to that of the host.
    """
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
        a0, a1 = adjoint[i], adjoint[6 + i]
        a2, a3 = adjoint[12 + i], adjoint[18 + i]
        a4, a5 = adjoint[24 + i], adjoint[30 + i]
        for k in range(BLOCK):
            s[(HOST_AT + i) * BLOCK + k] += (
                a0 * s[32 * BLOCK + k]
                + a1 * s[33 * BLOCK + k]
                + a2 * s[34 * BLOCK + k]
                + a3 * s[35 * BLOCK + k]
                + a4 * s[36 * BLOCK + k]
                + a5 * s[37 * BLOCK + k]
            )
