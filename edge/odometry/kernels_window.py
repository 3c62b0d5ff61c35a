"""Photometric residuals of the whole window: linearisation, sums, Schur complement.

Vector lanes are points. Points of one host lie together, padded to blocks of
BLOCK lanes; a padding lane has no active residual. Jacobians of the geometry
are taken at the first estimates (FEJ), image gradients at the current ones
(Engel et al. 2018, sec. 2.3).
"""

import numpy as np

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
SCRATCH_ROWS = 48


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
    flat, flat_mask = images.reshape(-1), mask.reshape(-1)
    row = np.int32(3 * width)
    mask_row = np.int32(width)
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    ifx, ify = ONE / fx, ONE / fy
    u_max, v_max = np.float32(width - 2), np.float32(height - 2)
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
            base = np.int64(slots[target]) * np.int64(height) * np.int64(row)
            r00, r01, r02 = warp[host, target, 0], warp[host, target, 1], warp[host, target, 2]
            r10, r11, r12 = warp[host, target, 3], warp[host, target, 4], warp[host, target, 5]
            r20, r21, r22 = warp[host, target, 6], warp[host, target, 7], warp[host, target, 8]
            t0, t1, t2 = warp[host, target, 9], warp[host, target, 10], warp[host, target, 11]
            gain, offset = affine[host, target, 0], affine[host, target, 1]
            gain_first = affine[host, target, 2]
            host_first, host_now = offset_first[0, host], offset_first[1, host]
            limit = max(energy_limit[host], energy_limit[target])
            for q in range(17):
                for k in range(BLOCK):
                    s[q, k] = ZERO
            for k in range(BLOCK):
                s[16, k] = np.float32(active[target, start + k])
            for q in range(PATTERN_SIZE):
                pu, pv = PATTERN_U[q], PATTERN_V[q]
                for k in range(BLOCK):
                    p = start + k
                    x = (points[U, p] + pu - cx) * ifx
                    y = (points[V, p] + pv - cy) * ify
                    idepth = points[IDEPTH, p]
                    z = r20 * x + r21 * y + r22 + t2 * idepth
                    inv = ONE / (z if z > FAR else ONE)
                    u = fx * (r00 * x + r01 * y + r02 + t0 * idepth) * inv + cx
                    v = fy * (r10 * x + r11 * y + r12 + t1 * idepth) * inv + cy
                    inside = (z > FAR) and (u > ONE) and (v > ONE) and (u < u_max) and (v < v_max)
                    u = u if inside else ONE
                    v = v if inside else ONE
                    x0, y0 = np.int32(u), np.int32(v)
                    visible = inside and (flat_mask[y0 * mask_row + x0] > 0)
                    s[16, k] = s[16, k] if visible else ZERO
                    fu, fv = u - np.float32(x0), v - np.float32(y0)
                    at = base + np.int64(y0 * row + np.int32(3) * x0)
                    w11 = fu * fv
                    w01 = fu - w11
                    w10 = fv - w11
                    w00 = ONE - fu - fv + w11
                    grey = (
                        w00 * flat[at]
                        + w01 * flat[at + 3]
                        + w10 * flat[at + row]
                        + w11 * flat[at + row + 3]
                    )
                    gx = (
                        w00 * flat[at + 1]
                        + w01 * flat[at + 4]
                        + w10 * flat[at + row + 1]
                        + w11 * flat[at + row + 4]
                    )
                    gy = (
                        w00 * flat[at + 2]
                        + w01 * flat[at + 5]
                        + w10 * flat[at + row + 2]
                        + w11 * flat[at + row + 5]
                    )
                    colour = points[GREY + q, p]
                    r = grey - offset - gain * (colour - host_now)
                    ja = -gain_first * (colour - host_first)
                    g2 = gx * gx + gy * gy
                    wt = HALF * (np.sqrt(scale2 / (scale2 + g2)) + points[WEIGHT + q, p])
                    size = abs(r)
                    robust = ONE if size < huber else huber / size
                    w2 = wt * wt
                    w = w2 * robust
                    s[15, k] += w * r * r * (TWO - robust)
                    s[0, k] += w * gx * gx
                    s[1, k] += w * gx * gy
                    s[2, k] += w * gy * gy
                    s[3, k] += w * gx * ja
                    s[4, k] += w * gy * ja
                    s[5, k] -= w * gx
                    s[6, k] -= w * gy
                    s[7, k] += w * ja * ja
                    s[8, k] -= w * ja
                    s[9, k] += w
                    wr = w * r
                    s[10, k] += wr * gx
                    s[11, k] += wr * gy
                    s[12, k] += wr * ja
                    s[13, k] -= wr
                    s[14, k] += wr * r
            # Which residuals count; where not, their Gram sums become zero.
            block_energy = ZERO
            for k in range(BLOCK):
                p = start + k
                was = active[target, p] != 0
                visible = s[16, k] > HALF
                good = visible and (s[15, k] <= limit) and (s[0, k] + s[2, k] > TWO)
                value = s[15, k] if s[15, k] < limit else limit
                keep = ONE if good else ZERO
                value = value if good else limit
                block_energy += value if (was and visible) else ZERO
                energy[target, p] = s[15, k] if visible else limit
                seen = INLIER if good else OUTLIER
                seen = seen if visible else OUTSIDE
                state[target, p] = seen if was else UNUSED
                s[17, k] = keep
            total += float(block_energy)
            for q in range(15):
                for k in range(BLOCK):
                    s[q, k] = s[q, k] if s[17, k] > HALF else ZERO
            # Geometry at the first estimates: rows 18-23 are du/dxi, 24-29 dv/dxi, 30-31 depth.
            r00, r01 = warp_first[host, target, 0], warp_first[host, target, 1]
            r02, r10 = warp_first[host, target, 2], warp_first[host, target, 3]
            r11, r12 = warp_first[host, target, 4], warp_first[host, target, 5]
            r20, r21 = warp_first[host, target, 6], warp_first[host, target, 7]
            r22, t0 = warp_first[host, target, 8], warp_first[host, target, 9]
            t1, t2 = warp_first[host, target, 10], warp_first[host, target, 11]
            for k in range(BLOCK):
                p = start + k
                x = (points[U, p] - cx) * ifx
                y = (points[V, p] - cy) * ify
                idepth = points[IDEPTH, p]
                z = r20 * x + r21 * y + r22 + t2 * idepth
                inv = ONE / (z if z > FAR else ONE)
                X = (r00 * x + r01 * y + r02 + t0 * idepth) * inv
                Y = (r10 * x + r11 * y + r12 + t1 * idepth) * inv
                nid = idepth * inv
                s[18, k] = fx * nid
                s[19, k] = ZERO
                s[20, k] = -fx * X * nid
                s[21, k] = -fx * X * Y
                s[22, k] = fx * (ONE + X * X)
                s[23, k] = -fx * Y
                s[24, k] = ZERO
                s[25, k] = fy * nid
                s[26, k] = -fy * Y * nid
                s[27, k] = -fy * (ONE + Y * Y)
                s[28, k] = fy * X * Y
                s[29, k] = fy * X
                s[30, k] = fx * inv * (t0 - t2 * X)
                s[31, k] = fy * inv * (t1 - t2 * Y)
            # Sums of the pair, upper triangle row by row: xi (6), a, b.
            out = 0
            for i in range(6):
                for j in range(i, 6):
                    total_ij = ZERO
                    for k in range(BLOCK):
                        total_ij += s[18 + i, k] * (
                            s[0, k] * s[18 + j, k] + s[1, k] * s[24 + j, k]
                        ) + s[24 + i, k] * (s[1, k] * s[18 + j, k] + s[2, k] * s[24 + j, k])
                    sums[host, target, out] += total_ij
                    out += 1
                total_a, total_b = ZERO, ZERO
                for k in range(BLOCK):
                    total_a += s[18 + i, k] * s[3, k] + s[24 + i, k] * s[4, k]
                    total_b += s[18 + i, k] * s[5, k] + s[24 + i, k] * s[6, k]
                sums[host, target, out] += total_a
                sums[host, target, out + 1] += total_b
                out += 2
                total_r = ZERO
                for k in range(BLOCK):
                    total_r += s[18 + i, k] * s[10, k] + s[24 + i, k] * s[11, k]
                sums[host, target, 36 + i] += total_r
            for q in range(6):
                total_q = ZERO
                for k in range(BLOCK):
                    total_q += s[7 + q if q < 3 else 9 + q, k]
                at_sum = (33, 34, 35, 42, 43, 44)[q]
                sums[host, target, at_sum] += total_q
            # Depth part: rows 32-39 are the products with xi, a, b.
            for k in range(BLOCK):
                p = start + k
                du, dv = s[30, k], s[31, k]
                gu, gv = s[0, k] * du + s[1, k] * dv, s[1, k] * du + s[2, k] * dv
                Hd[p] += du * gu + dv * gv
                bd[p] += du * s[10, k] + dv * s[11, k]
                for i in range(6):
                    s[32 + i, k] = s[18 + i, k] * gu + s[24 + i, k] * gv
                s[38, k] = s[3, k] * du + s[4, k] * dv
                s[39, k] = s[5, k] * du + s[6, k] * dv
            for i in range(8):
                for k in range(BLOCK):
                    W[8 * target + i, start + k] += s[32 + i, k]
            for i in range(6):
                for j in range(6):
                    factor = adjoint[host, target, 6 * j + i]
                    for k in range(BLOCK):
                        W[8 * host + i, start + k] += factor * s[32 + j, k]
            for k in range(BLOCK):
                W[8 * host + 6, start + k] -= s[38, k]
                W[8 * host + 7, start + k] -= gain_first * s[39, k]
    return total


@kernel
def stitch(sums: F64, adjoint: F32, affine: F32, H: F64, b: F64) -> None:
    """Turn the relative systems of all pairs into one of absolute frame states.

    sums     (f, f, 45)  as of `linearise`
    H, b     (8 f, 8 f), (8 f,)  float64, out
    """
    n_frames = sums.shape[0]
    H[:] = 0.0
    b[:] = 0.0
    G, M, HG = np.empty((8, 8)), np.zeros((8, 8)), np.empty((8, 8))
    for host in range(n_frames):
        for target in range(n_frames):
            if host == target or sums[host, target, 35] == 0.0:
                continue
            k = 0
            for i in range(8):
                for j in range(i, 8):
                    G[i, j] = G[j, i] = sums[host, target, k]
                    k += 1
            for i in range(6):
                for j in range(6):
                    M[i, j] = adjoint[host, target, 6 * i + j]
            M[6, 6] = -1.0
            M[7, 7] = -float(affine[host, target, 2])
            for i in range(8):
                for j in range(8):
                    total = 0.0
                    for m in range(8):
                        total += G[i, m] * M[m, j]
                    HG[i, j] = total
            for i in range(8):
                total_b = 0.0
                for m in range(8):
                    total_b += M[m, i] * sums[host, target, 36 + m]
                b[8 * host + i] += total_b
                b[8 * target + i] += sums[host, target, 36 + i]
                for j in range(8):
                    total = 0.0
                    for m in range(8):
                        total += M[m, i] * HG[m, j]
                    H[8 * host + i, 8 * host + j] += total
                    H[8 * target + i, 8 * target + j] += G[i, j]
                    H[8 * target + i, 8 * host + j] += HG[i, j]
                    H[8 * host + j, 8 * target + i] += HG[i, j]


@kernel
def depth_steps(W: F32, Hd: F32, bd: F32, dx: F32, damping: np.float32, out: F32) -> None:
    """Back-substitute: the step of every inverse depth, given the frames' steps dx (8 f,)."""
    for p in range(Hd.shape[0]):
        out[p] = bd[p]
    for i in range(dx.shape[0]):
        step = dx[i]
        for p in range(Hd.shape[0]):
            out[p] += W[i, p] * step
    for p in range(Hd.shape[0]):
        h = Hd[p] * (ONE + damping)
        out[p] = -out[p] / h if h > np.float32(1e-3) else ZERO


@kernel
def eliminate_depths(
    W: F32, Hd: F32, bd: F32, damping: np.float32, scaled: F32, H: F64, b: F64
) -> None:
    """Schur complement over the depths: H -= W Hd^-1 W^T, b -= W Hd^-1 bd.

    W, scaled  (8 f, n)  float32; scaled is scratch: W / Hd, column by column
    H, b       (8 f, 8 f), (8 f,)  float64, in and out

    Our own loop, since a BLAS call of this size took 2 to 30 ms where this takes 0.3.
    """
    rows, n = W.shape
    for i in range(rows):
        for p in range(n):
            h = Hd[p] * (ONE + damping)
            # A point that no residual holds adds nothing.
            scaled[i, p] = W[i, p] / h if h > np.float32(1e-3) else ZERO
    for i in range(rows):
        total_b = ZERO
        for p in range(n):
            total_b += scaled[i, p] * bd[p]
        b[i] -= total_b
        j = i
        while j < rows:
            # Two rows at a time share the loads of row i.
            other = j + 1 if j + 1 < rows else j
            s0, s1 = ZERO, ZERO
            for p in range(n):
                w = W[i, p]
                s0 += w * scaled[j, p]
                s1 += w * scaled[other, p]
            H[i, j] -= s0
            if j != i:
                H[j, i] -= s0
            if other != j:
                H[i, other] -= s1
                H[other, i] -= s1
            j += 2
