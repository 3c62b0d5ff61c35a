# SPDX-License-Identifier: Apache-2.0
"""The search for a pose among matches of which many are wrong."""

import math

import numpy as np

from edge.kernel import inline_kernel, kernel
from edge.relocalise.kernels_likelihood import likelihood_gain
from edge.relocalise.kernels_p3p import p3p
from edge.relocalise.kernels_pose import mahalanobis, refine
from edge.types import F64, I32, Pinhole

_MIN_SAMPLE_AREA_PX2 = 200.0  # thinner triangles give poses of no worth
_LOCAL_STEPS = 4
_NO_GATE = 1e15
_FIRST_POOL = 12  # the search begins among so many of the best matches


@inline_kernel
def next_random(state):  # type: ignore[no-untyped-def]
    """Step of xorshift64 (Marsaglia 2003); the state is a uint64 other than 0."""
    state ^= state << np.uint64(13)
    state ^= state >> np.uint64(7)
    state ^= state << np.uint64(17)
    return state


@kernel
def search(
    pixels: F64,
    xyz: F64,
    C: F64,
    variance: F64,
    bearings: F64,
    order: I32,
    camera: Pinhole,
    seed: int,
    max_rounds: int,
    clutter_px2: float,
    gate: float,
    R: F64,
    p: F64,
) -> tuple[float, int]:
    """Set R, p to the pose that explains the matches best; return its gain and the rounds.

    Samples are drawn from a growing pool of the most promising matches (after PROSAC, Chum and
    Matas 2005); each new best is improved on its inliers before it counts (LO-RANSAC, 2003).

    bearings  (n, 3)  float64  unit, camera frame
    order     (k,)    int32    matches to sample from, most promising first
    R, p      (3, 3), (3,)  float64, out
    """
    n, k = pixels.shape[0], order.shape[0]
    Rs, ps = np.empty((4, 3, 3)), np.empty((4, 3))
    R_local, p_local, H = np.empty((3, 3)), np.empty(3), np.empty((6, 6))
    y, x = np.empty((3, 3)), np.empty((3, 3))
    m2, spread, use = np.empty(n), np.empty(n), np.empty(n)
    sample = np.empty(3, np.int32)
    state = np.uint64(seed) * np.uint64(0x9E3779B97F4A7C15) + np.uint64(0x2545F4914F6CDD1D)
    if state == np.uint64(0):
        state = np.uint64(1)
    best, needed, done = 0.0, max_rounds, 0
    while done < needed:
        pool = min(k, _FIRST_POOL + done)
        done += 1
        for j in range(3):
            state = next_random(state)
            sample[j] = order[np.int64(state >> np.uint64(11)) % pool]
        if sample[0] == sample[1] or sample[0] == sample[2] or sample[1] == sample[2]:
            continue
        ux, uy = (
            pixels[sample[1], 0] - pixels[sample[0], 0],
            pixels[sample[1], 1] - pixels[sample[0], 1],
        )
        wx, wy = (
            pixels[sample[2], 0] - pixels[sample[0], 0],
            pixels[sample[2], 1] - pixels[sample[0], 1],
        )
        if abs(ux * wy - uy * wx) < 2.0 * _MIN_SAMPLE_AREA_PX2:
            continue
        for j in range(3):
            for c in range(3):
                y[j, c] = bearings[sample[j], c]
                x[j, c] = xyz[sample[j], c]
        for h in range(p3p(y, x, Rs, ps)):
            gain = likelihood_gain(
                pixels, xyz, C, variance, camera, Rs[h], ps[h], clutter_px2, gate
            )
            if gain <= best:
                continue
            best = gain
            for r in range(3):
                p[r] = p_local[r] = ps[h, r]
                for c in range(3):
                    R[r, c] = R_local[r, c] = Rs[h, r, c]
            mahalanobis(pixels, xyz, C, variance, camera, R_local, p_local, m2, spread)
            for i in range(n):
                use[i] = 1.0 if m2[i] < 2.0 * gate else 0.0
            refine(
                pixels,
                xyz,
                C,
                variance,
                use,
                camera,
                R_local,
                p_local,
                gate,
                _NO_GATE,
                _LOCAL_STEPS,
                H,
            )
            gain = likelihood_gain(
                pixels, xyz, C, variance, camera, R_local, p_local, clutter_px2, gate
            )
            if gain > best:
                best = gain
                for r in range(3):
                    p[r] = p_local[r]
                    for c in range(3):
                        R[r, c] = R_local[r, c]
            needed = min(
                max_rounds,
                _rounds_needed(pixels, xyz, C, variance, camera, R, p, m2, spread, order, gate),
            )
    return best, done


@inline_kernel
def _rounds_needed(pixels, xyz, C, variance, camera, R, p, m2, spread, order, gate):  # type: ignore[no-untyped-def]
    """Rounds after which a better pose would have been sampled with 99.9 %."""
    mahalanobis(pixels, xyz, C, variance, camera, R, p, m2, spread)
    good = 0
    for j in range(order.shape[0]):
        if m2[order[j]] < gate:
            good += 1
    share = good / order.shape[0]
    chance = min(max(share * share * share, 1e-9), 0.999)
    # A sample of exact inliers still gives a poor pose now and then: ask for some more.
    return 20 + int(2.0 * math.log(0.001) / math.log(1.0 - chance))
