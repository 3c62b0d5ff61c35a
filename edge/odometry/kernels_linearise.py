# SPDX-License-Identifier: Apache-2.0
"""Linearises a window's photometric residuals, block by block (Engel et al. 2018, sec. 2.3)."""

import numpy as np

from edge.kernel import kernel
from edge.odometry.kernels_window import (
    BD_AT,
    BLOCK,
    HALF,
    HD_AT,
    HOST_AT,
    INLIER,
    ONE,
    OUTLIER,
    OUTSIDE,
    POINT_AT,
    POINT_ROWS,
    SCRATCH_ROWS,
    TWO,
    UNUSED,
    ZERO,
    add_depths,
    add_pair,
    derive_geometry,
    sample_pattern,
)
from edge.types import F32, F64, I32, U8


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
            derive_geometry(intrinsics, warp_first[host, target], s)
            add_pair(s, sums[host, target])
            add_depths(adjoint[host, target], gain_first, s)
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
