# SPDX-License-Identifier: Apache-2.0
"""The window's system: pairs of frames stitched together, depths eliminated and put back."""

import numpy as np

from edge.kernel import kernel
from edge.types import F32, F64

ZERO, ONE = np.float32(0.0), np.float32(1.0)
# A point whose depth is held by less than this is not held at all.
MIN_DEPTH_HESSIAN = np.float32(1e-3)


@kernel
def stitch(sums: F64, adjoint: F32, affine: F32, H: F64, b: F64) -> None:
    """Turn the relative systems of all pairs into one of absolute frame states.

    sums     (f, f, 45)  as of `kernels_linearise.linearise`
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
        out[p] = -out[p] / h if h > MIN_DEPTH_HESSIAN else ZERO


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
            scaled[i, p] = W[i, p] / h if h > MIN_DEPTH_HESSIAN else ZERO
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
