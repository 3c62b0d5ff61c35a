# SPDX-License-Identifier: Apache-2.0
"""Coarse-to-fine photometric tracking of one frame against a keyframe's points.

The residual of a reference point with grey g in the new image I is
`(I(x') - b) - exp(a) (g - b_ref)` (Engel et al. 2018, eq. 4, exposure times
unknown); `b_ref` is already taken off the point's grey.
"""

import math

import numpy as np

from edge.geometry.kernels import exp_times, solve_symmetric
from edge.image.sampling import sample
from edge.kernel import kernel
from edge.types import F32, F64, U8

ZERO = np.float32(0.0)
ONE = np.float32(1.0)
TWO = np.float32(2.0)
FAR = np.float32(1e-6)
N_SUMS = 49  # 36 of the Hessian, 8 of the gradient, energy, and 4 counts


@kernel
def accumulate(
    image: F32,
    mask: U8,
    points: F32,
    n: int,
    intrinsics: F32,
    R64: F64,
    t64: F64,
    affine: F64,
    huber: np.float32,
    cutoff: np.float32,
    sums: F64,
) -> None:
    """Sum up the Gauss-Newton system of one pyramid level.

    image       (h, w, 3)  float32  grey and gradient of the new frame
    mask        (h, w)     uint8    1 where a pattern may lie
    points      (5, n..)   float32  x/z, y/z, inverse depth, grey - b_ref, weight
    intrinsics  (4,)       float32  fx fy cx cy of this level
    R64, t64    (3, 3), (3,)        T_new_ref
    affine      (2,)                a, b
    sums        (49,)      float64, out: upper triangle of H (36), gradient (8),
                energy, points used, points in view, cut-off points, sum of weights
    """
    flat = image.reshape(-1)
    height, width = mask.shape
    flat_mask = mask.reshape(-1)
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    r00, r01, r02 = np.float32(R64[0, 0]), np.float32(R64[0, 1]), np.float32(R64[0, 2])
    r10, r11, r12 = np.float32(R64[1, 0]), np.float32(R64[1, 1]), np.float32(R64[1, 2])
    r20, r21, r22 = np.float32(R64[2, 0]), np.float32(R64[2, 1]), np.float32(R64[2, 2])
    t0, t1, t2 = np.float32(t64[0]), np.float32(t64[1]), np.float32(t64[2])
    gain, offset = np.float32(math.exp(affine[0])), np.float32(affine[1])
    u_max, v_max = np.float32(width - 2), np.float32(height - 2)
    row = np.int32(3 * width)

    h00 = h01 = h02 = h03 = h04 = h05 = h06 = h07 = ZERO
    h11 = h12 = h13 = h14 = h15 = h16 = h17 = ZERO
    h22 = h23 = h24 = h25 = h26 = h27 = ZERO
    h33 = h34 = h35 = h36 = h37 = ZERO
    h44 = h45 = h46 = h47 = ZERO
    h55 = h56 = h57 = ZERO
    h66 = h67 = ZERO
    h77 = ZERO
    b0 = b1 = b2 = b3 = b4 = b5 = b6 = b7 = ZERO
    energy = used = seen = cut = weights = ZERO

    for i in range(n):
        x, y, idepth = points[0, i], points[1, i], points[2, i]
        pz = r20 * x + r21 * y + r22 + t2 * idepth
        pz_safe = pz if pz > FAR else ONE
        inv = ONE / pz_safe
        X = (r00 * x + r01 * y + r02 + t0 * idepth) * inv
        Y = (r10 * x + r11 * y + r12 + t1 * idepth) * inv
        u = fx * X + cx
        v = fy * Y + cy
        inside = (pz > FAR) & (u > ONE) & (v > ONE) & (u < u_max) & (v < v_max)
        u = u if inside else ONE
        v = v if inside else ONE
        x0, y0 = np.int32(u), np.int32(v)
        ok = np.float32(flat_mask[y0 * np.int32(width) + x0])
        ok = ok if inside else ZERO
        fu, fv = u - np.float32(x0), v - np.float32(y0)
        at = y0 * row + np.int32(3) * x0
        grey, gx, gy = sample(flat, at, row, fu, fv)
        predicted = gain * points[3, i]
        r = grey - offset - predicted
        size = abs(r)
        within = ONE if size < cutoff else ZERO
        robust = ONE if size < huber else huber / size
        weight = points[4, i] * ok * within
        energy += (
            points[4, i]
            * ok
            * (
                within * robust * r * r * (TWO - robust)
                + (ONE - within) * huber * (TWO * cutoff - huber)
            )
        )
        used += ok * within
        seen += ok
        cut += ok * (ONE - within)
        weights += points[4, i] * ok
        w = weight * robust

        nid = idepth * inv
        jx, jy = fx * gx, fy * gy
        j0 = jx * nid
        j1 = jy * nid
        j2 = -(j0 * X + j1 * Y)
        dot = jx * X + jy * Y
        j3 = -(dot * Y + jy)
        j4 = dot * X + jx
        j5 = jy * X - jx * Y
        j6 = -predicted
        j7 = -ONE
        h00 += w * j0 * j0
        h01 += w * j0 * j1
        h02 += w * j0 * j2
        h03 += w * j0 * j3
        h04 += w * j0 * j4
        h05 += w * j0 * j5
        h06 += w * j0 * j6
        h07 += w * j0 * j7
        h11 += w * j1 * j1
        h12 += w * j1 * j2
        h13 += w * j1 * j3
        h14 += w * j1 * j4
        h15 += w * j1 * j5
        h16 += w * j1 * j6
        h17 += w * j1 * j7
        h22 += w * j2 * j2
        h23 += w * j2 * j3
        h24 += w * j2 * j4
        h25 += w * j2 * j5
        h26 += w * j2 * j6
        h27 += w * j2 * j7
        h33 += w * j3 * j3
        h34 += w * j3 * j4
        h35 += w * j3 * j5
        h36 += w * j3 * j6
        h37 += w * j3 * j7
        h44 += w * j4 * j4
        h45 += w * j4 * j5
        h46 += w * j4 * j6
        h47 += w * j4 * j7
        h55 += w * j5 * j5
        h56 += w * j5 * j6
        h57 += w * j5 * j7
        h66 += w * j6 * j6
        h67 += w * j6 * j7
        h77 += w
        wr = w * r
        b0 += wr * j0
        b1 += wr * j1
        b2 += wr * j2
        b3 += wr * j3
        b4 += wr * j4
        b5 += wr * j5
        b6 += wr * j6
        b7 += wr * j7

    sums[0], sums[1], sums[2], sums[3] = h00, h01, h02, h03
    sums[4], sums[5], sums[6], sums[7] = h04, h05, h06, h07
    sums[8], sums[9], sums[10], sums[11] = h11, h12, h13, h14
    sums[12], sums[13], sums[14] = h15, h16, h17
    sums[15], sums[16], sums[17], sums[18], sums[19], sums[20] = h22, h23, h24, h25, h26, h27
    sums[21], sums[22], sums[23], sums[24], sums[25] = h33, h34, h35, h36, h37
    sums[26], sums[27], sums[28], sums[29] = h44, h45, h46, h47
    sums[30], sums[31], sums[32] = h55, h56, h57
    sums[33], sums[34], sums[35] = h66, h67, h77
    sums[36], sums[37], sums[38], sums[39] = b0, b1, b2, b3
    sums[40], sums[41], sums[42], sums[43] = b4, b5, b6, b7
    sums[44], sums[45], sums[46], sums[47], sums[48] = energy, used, seen, cut, weights


@kernel
def unpack(sums: F64, H: F64, b: F64) -> None:
    """Expand the packed upper triangle of `sums` into H (8, 8) and b (8,)."""
    k = 0
    for i in range(8):
        b[i] = sums[36 + i]
        for j in range(i, 8):
            H[i, j] = H[j, i] = sums[k]
            k += 1


@kernel
def track_level(
    image: F32,
    mask: U8,
    points: F32,
    n: int,
    intrinsics: F32,
    R: F64,
    t: F64,
    affine: F64,
    affine_prior: F64,
    huber: np.float32,
    cutoff_start: np.float32,
    max_iterations: int,
    min_step: float,
    sums: F64,
) -> float:
    """Improve T_new_ref = (R, t) and affine in place by Levenberg-Marquardt.

    affine_prior  (4,)  expected a, b and the inverse variances of both, in units
                  of the mean weighted residual
    sums          (49,) out, as of `accumulate`, at the result

    Returns the cut-off that was used [grey]: it is widened while more than half
    of the visible points lie beyond it.
    """
    H, A = np.empty((8, 8)), np.empty((8, 8))
    b, step = np.empty(8), np.empty(8)
    R_new, t_new, affine_new = np.empty((3, 3)), np.empty(3), np.empty(2)
    trial = np.empty(49)
    cutoff = cutoff_start
    accumulate(image, mask, points, n, intrinsics, R, t, affine, huber, cutoff, sums)
    while sums[47] > 0.5 * sums[46] and cutoff < 10 * cutoff_start:
        cutoff *= TWO
        accumulate(image, mask, points, n, intrinsics, R, t, affine, huber, cutoff, sums)
    damping = 0.01
    for _ in range(max_iterations):
        unpack(sums, H, b)
        for k in range(2):
            H[6 + k, 6 + k] += affine_prior[2 + k] * sums[48]
            b[6 + k] += affine_prior[2 + k] * sums[48] * (affine[k] - affine_prior[k])
        for i in range(8):
            for j in range(8):
                A[i, j] = H[i, j]
            A[i, i] += damping * H[i, i] + 1e-6
            b[i] = -b[i]
        if not solve_symmetric(A, b, step):
            break
        exp_times(step[:6], R, t, R_new, t_new)
        affine_new[0] = affine[0] + step[6]
        affine_new[1] = affine[1] + step[7]
        if abs(affine_new[0]) > 5.0:
            break
        accumulate(
            image, mask, points, n, intrinsics, R_new, t_new, affine_new, huber, cutoff, trial
        )
        mean_new = (trial[44] / max(trial[48], 1e-6)) if trial[46] > 0 else 1e30
        mean_old = sums[44] / max(sums[48], 1e-6)
        for k in range(2):
            mean_new += affine_prior[2 + k] * (affine_new[k] - affine_prior[k]) ** 2
            mean_old += affine_prior[2 + k] * (affine[k] - affine_prior[k]) ** 2
        # A step that throws half of the points out of the image is no improvement.
        if mean_new < mean_old and trial[46] > 0.7 * sums[46]:
            R[:], t[:], affine[:] = R_new, t_new, affine_new
            sums[:] = trial
            damping = max(damping * 0.3, 1e-7)
            size = 0.0
            for k in range(6):
                size += step[k] * step[k]
            if math.sqrt(size) < min_step:
                break
        else:
            damping = max(damping * 5.0, 1e-4)
            if damping > 1e4:
                break
            size = 0.0
            for k in range(6):
                size += step[k] * step[k]
            if math.sqrt(size) < 0.1 * min_step:
                break
    return float(cutoff)
