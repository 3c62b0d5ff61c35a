# SPDX-License-Identifier: Apache-2.0
"""How the window's residuals depend on lens and shutter: columns beside poses and depths."""

import math

import numpy as np

from edge.image.sampling import sample
from edge.kernel import kernel
from edge.odometry.kernels_window import (
    BLOCK,
    GREY,
    IDEPTH,
    INLIER,
    PATTERN_SIZE,
    PATTERN_U,
    PATTERN_V,
    WEIGHT,
    U,
    V,
)
from edge.types import F32, F64, I32, U8

ZERO, ONE, HALF = np.float32(0.0), np.float32(1.0), np.float32(0.5)
# log of the focal length's factor, first radial coefficient, read-out time [s] as the camera's
# turning shows it, and as its translation does: these move pixels. Then the log of how much
# brighter a corner should be made against the centre.
N_MOVING, N_LENS = 4, 5


@kernel
def lens_system(
    images: F32,
    slots: I32,
    block_host: I32,
    points: F32,
    state: U8,
    intrinsics: F32,
    warp: F32,
    warp_first: F32,
    affine: F32,
    offset_first: F32,
    huber: np.float32,
    gradient_scale: np.float32,
    adjoint: F32,
    turning: F32,
    velocity: F32,
    H: F64,
    b: F64,
    H_frames: F64,
    H_depths: F32,
) -> None:
    """Sum up what all inlier residuals say of the lens.

    images, slots, block_host, points, intrinsics, warp, warp_first, affine, offset_first,
    huber, gradient_scale, adjoint, state
              as of `kernels_linearise.linearise`, so that both fit together
    turning   (f, 3)     float32  angular rates of the frames in their own axes [rad/s]
    velocity  (f, 3)     float32  rates of a still point's coordinates by translation [1/s]
    H, b      (5, 5), (5,)        float64, out
    H_frames  (5, 8 f)   float64, out: with the frames' absolute states
    H_depths  (5, n)     float32, out: with the inverse depths

    The camera maps a true ray (x, y) to the pixel c + f e^s (1 + k r^2) (x, y), and moves on
    while its rows are read; the middle row's moment counts. All are zero where the images'
    undistortion is right. Both ends of a residual move. A grey value is multiplied by
    exp(k rho^2), rho being the distance from the axis, 1 in a corner.
    """
    n_frames = slots.shape[0]
    _, height, width, _ = images.shape
    flat = images.reshape(-1)
    row = 3 * width
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    scale2 = gradient_scale * gradient_scale
    H[:] = 0.0
    b[:] = 0.0
    H_frames[:] = 0.0
    H_depths[:] = ZERO
    tall = ONE / np.float32(height)
    corner = np.float32(4.0 / (height * height + width * width))
    ax, ay = np.empty(N_MOVING, np.float32), np.empty(N_MOVING, np.float32)
    hx, hy = np.empty(N_MOVING, np.float32), np.empty(N_MOVING, np.float32)
    Ju, Jv = np.empty(N_MOVING, np.float32), np.empty(N_MOVING, np.float32)
    Pu, Pv = np.empty(6, np.float32), np.empty(6, np.float32)
    # With the states of a pair relative to one another, (host, target, 5, 8).
    pairs = np.zeros((n_frames, n_frames, N_LENS, 8))
    for p in range(points.shape[1]):
        host = block_host[p // BLOCK]
        x, y, idepth = (points[U, p] - cx) / fx, (points[V, p] - cy) / fy, points[IDEPTH, p]
        ray_2 = x * x + y * y
        # The true ray of the host's pixel moves against the lens.
        hx[0], hy[0], hx[1], hy[1] = -x, -y, -x * ray_2, -y * ray_2
        late = points[V, p] * tall - HALF
        spin = turning[host, 0] * y - turning[host, 1] * x
        hx[2] = -late * (turning[host, 2] * y - turning[host, 1] + x * spin)
        hy[2] = -late * (turning[host, 0] - turning[host, 2] * x + y * spin)
        hx[3] = -late * idepth * (velocity[host, 0] - x * velocity[host, 2])
        hy[3] = -late * idepth * (velocity[host, 1] - y * velocity[host, 2])
        host_2 = corner * (fx * fx * x * x + fy * fy * y * y)
        for target in range(n_frames):
            if target == host or state[target, p] != INLIER:
                continue
            T = warp[host, target]
            gain, gain_first = affine[host, target, 0], affine[host, target, 2]
            base = np.int64(slots[target]) * height * row
            guu = guv = gvv = gua = gva = gu1 = gv1 = gur = gvr = ZERO
            guk = gvk = gkk = gka = gk1 = gkr = ZERO
            inside = True
            for q in range(PATTERN_SIZE):
                xq, yq = x + PATTERN_U[q] / fx, y + PATTERN_V[q] / fy
                z = T[6] * xq + T[7] * yq + T[8] + T[11] * idepth
                u = fx * (T[0] * xq + T[1] * yq + T[2] + T[9] * idepth) / z + cx
                v = fy * (T[3] * xq + T[4] * yq + T[5] + T[10] * idepth) / z + cy
                if not (z > ZERO and u > ONE and v > ONE and u < width - 2 and v < height - 2):
                    inside = False
                    break
                x0, y0 = int(u), int(v)
                at = base + y0 * row + 3 * x0
                grey, gx, gy = sample(flat, at, row, u - np.float32(x0), v - np.float32(y0))
                ja = -gain_first * (points[GREY + q, p] - offset_first[0, host])
                r = grey - affine[host, target, 1]
                r -= gain * (points[GREY + q, p] - offset_first[1, host])
                away_2 = (u - cx) * (u - cx) + (v - cy) * (v - cy)
                jk = grey * corner * away_2 - gain * points[GREY + q, p] * host_2
                w = HALF * (
                    math.sqrt(scale2 / (scale2 + gx * gx + gy * gy)) + points[WEIGHT + q, p]
                )
                size = abs(r)
                w *= w * (ONE if size < huber else huber / size)
                guu += w * gx * gx
                guv += w * gx * gy
                gvv += w * gy * gy
                gua += w * gx * ja
                gva += w * gy * ja
                gu1 -= w * gx
                gv1 -= w * gy
                gur += w * gx * r
                gvr += w * gy * r
                guk += w * gx * jk
                gvk += w * gy * jk
                gkk += w * jk * jk
                gka += w * jk * ja
                gk1 -= w * jk
                gkr += w * jk * r
            if not inside:
                continue
            T = warp_first[host, target]
            inv = ONE / (T[6] * x + T[7] * y + T[8] + T[11] * idepth)
            X = (T[0] * x + T[1] * y + T[2] + T[9] * idepth) * inv
            Y = (T[3] * x + T[4] * y + T[5] + T[10] * idepth) * inv
            seen_2 = X * X + Y * Y
            ax[0], ay[0], ax[1], ay[1] = X, Y, X * seen_2, Y * seen_2
            late = (fy * Y + cy) * tall - HALF
            spin = turning[target, 0] * Y - turning[target, 1] * X
            ax[2] = late * (turning[target, 2] * Y - turning[target, 1] + X * spin)
            ay[2] = late * (turning[target, 0] - turning[target, 2] * X + Y * spin)
            ax[3] = late * idepth * inv * (velocity[target, 0] - X * velocity[target, 2])
            ay[3] = late * idepth * inv * (velocity[target, 1] - Y * velocity[target, 2])
            for m in range(N_MOVING):
                dz = T[6] * hx[m] + T[7] * hy[m]
                Ju[m] = fx * (ax[m] + inv * (T[0] * hx[m] + T[1] * hy[m] - X * dz))
                Jv[m] = fy * (ay[m] + inv * (T[3] * hx[m] + T[4] * hy[m] - Y * dz))
            nid = idepth * inv
            Pu[0], Pu[1], Pu[2] = fx * nid, ZERO, -fx * X * nid
            Pu[3], Pu[4], Pu[5] = -fx * X * Y, fx * (ONE + X * X), -fx * Y
            Pv[0], Pv[1], Pv[2] = ZERO, fy * nid, -fy * Y * nid
            Pv[3], Pv[4], Pv[5] = -fy * (ONE + Y * Y), fy * X * Y, fy * X
            du, dv = fx * inv * (T[9] - T[11] * X), fy * inv * (T[10] - T[11] * Y)
            for m in range(N_LENS):
                if m < N_MOVING:
                    ju, jv = Ju[m] * guu + Jv[m] * guv, Ju[m] * guv + Jv[m] * gvv
                    pull_a = Ju[m] * gua + Jv[m] * gva
                    pull_b = Ju[m] * gu1 + Jv[m] * gv1
                    H[m, N_MOVING] += Ju[m] * guk + Jv[m] * gvk
                    b[m] += Ju[m] * gur + Jv[m] * gvr
                else:
                    ju, jv, pull_a, pull_b = guk, gvk, gka, gk1
                    H[m, m] += gkk
                    b[m] += gkr
                for k in range(N_MOVING):
                    H[m, k] += ju * Ju[k] + jv * Jv[k]
                H_depths[m, p] += ju * du + jv * dv
                for i in range(6):
                    pairs[host, target, m, i] += ju * Pu[i] + jv * Pv[i]
                pairs[host, target, m, 6] += pull_a
                pairs[host, target, m, 7] += pull_b
    for host in range(n_frames):
        for target in range(n_frames):
            for m in range(N_LENS):
                relative = pairs[host, target, m]
                for i in range(8):
                    H_frames[m, 8 * target + i] += relative[i]
                H_frames[m, 8 * host + 6] -= relative[6]
                H_frames[m, 8 * host + 7] -= affine[host, target, 2] * relative[7]
                for j in range(6):
                    for i in range(6):
                        H_frames[m, 8 * host + j] += relative[i] * adjoint[host, target, 6 * i + j]
