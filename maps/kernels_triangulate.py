# SPDX-License-Identifier: Apache-2.0
"""A point from its views: first guess by pairs, robust refinement, information."""

import math

import numpy as np

from edge.kernel import inline_kernel, kernel
from maps.kernels_refine import chi2, normal_equations, refine

_MAX_GUESSES = 24  # pairs of views tried for the first guess


@inline_kernel
def _midpoint(c0, r0, c1, r1, X):  # type: ignore[no-untyped-def]
    """Write to X (3,) the point nearest to two lines (centres c, unit directions r).

    It may lie behind; what an observation costs there tells. False where they are parallel.
    """
    b0, b1, b2 = c1[0] - c0[0], c1[1] - c0[1], c1[2] - c0[2]
    cosine = r0[0] * r1[0] + r0[1] * r1[1] + r0[2] * r1[2]
    along0 = b0 * r0[0] + b1 * r0[1] + b2 * r0[2]
    along1 = b0 * r1[0] + b1 * r1[1] + b2 * r1[2]
    sine2 = 1.0 - cosine * cosine
    if sine2 < 1e-12:
        return False
    s0 = (along0 - cosine * along1) / sine2
    s1 = (cosine * along0 - along1) / sine2
    for k in range(3):
        X[k] = 0.5 * (c0[k] + s0 * r0[k] + c1[k] + s1 * r1[k])
    return True


@kernel
def _guess(T, K, centres, rays, views, pixels, sigma, depth, depth_sigma, begin, end, gate, X):  # type: ignore[no-untyped-def]
    """Write to X the guess that most observations agree with; return whether there is one.

    Guesses are the meeting points of pairs of rays, and the given depths.
    """
    trial, r = np.empty(3), np.empty(5)
    n = end - begin
    pairs = n * (n - 1) // 2
    step = max(1, pairs // _MAX_GUESSES)
    best_cost = 1e300
    for guess in range(-n, pairs):
        if guess < 0:
            i = begin - guess - 1
            if depth[i] <= 0.0:
                continue
            view = views[i]
            # rays are unit vectors in the map frame; depth is along the camera's z axis.
            forward = 0.0
            for k in range(3):
                forward += T[view, 2, k] * rays[i, k]
            for k in range(3):
                trial[k] = centres[view, k] + rays[i, k] * depth[i] / forward
        else:
            if guess % step != 0:
                continue
            # Unrank the pair: row a holds the pairs (a, a + 1..n - 1).
            a, left = 0, guess
            while left >= n - 1 - a:
                left -= n - 1 - a
                a += 1
            i, j = begin + a, begin + a + 1 + left
            if not _midpoint(centres[views[i]], rays[i], centres[views[j]], rays[j], trial):
                continue
        cost = 0.0
        for row in range(begin, end):
            pixel, along = chi2(T, K, trial, views[row], pixels, sigma, depth, depth_sigma, row, r)
            cost += min(pixel, gate) + min(along, gate)
        if cost < best_cost:
            best_cost = cost
            for k in range(3):
                X[k] = trial[k]
    return best_cost < 1e300


@kernel
def triangulate(  # type: ignore[no-untyped-def]
    T,
    K,
    centres,
    rays,
    offsets,
    views,
    pixels,
    sigma,
    sigma_shared,
    depth,
    depth_sigma,
    gate,
    huber,
    xyz,
    information,
    used,
    parallax,
):
    """Fuse the observations of every track into a point; tell which of them agree with it.

    T            (v, 4, 4)  float64  T_cam_map of each view
    K            (v, 4)     float64  fx fy cx cy of each view
    centres      (v, 3)     float64  camera centres in the map frame
    rays         (m, 3)     float64  unit vectors in the map frame of each observation
    offsets      (n + 1,)   int64    rows of each track
    views        (m,)       int32    of each observation
    pixels       (m, 2)     float64  ideal
    sigma        (m,)       float64  of the pixels
    sigma_shared (m,)       float64  with what views share; for the information alone
    depth        (m,)       float64  given along z, 0 where unknown
    depth_sigma  (m,)       float64
    gate         chi2 above which an observation is left out
    huber        standard deviations from which on the loss is linear
    xyz          (n, 3)     float64, out; nan where there is no point
    information  (n, 3, 3)  float64, out; lower triangle, of the used observations
    used         (m,)       uint8, out
    parallax     (n,)       float64, out; widest angle between two used rays [rad]
    """
    H, b, X, r = np.empty((3, 3)), np.empty(3), np.empty(3), np.empty(5)
    for track in range(offsets.shape[0] - 1):
        begin, end = offsets[track], offsets[track + 1]
        xyz[track] = np.nan
        parallax[track] = 0.0
        information[track] = 0.0
        for row in range(begin, end):
            used[row] = 0
        if not _guess(
            T, K, centres, rays, views, pixels, sigma, depth, depth_sigma, begin, end, 4.0 * gate, X
        ):
            continue
        sound = True
        for attempt in range(4):
            changed = False
            count = 0  # two pixels, or a pixel and its depth, make a point
            for row in range(begin, end):
                pixel, along = chi2(T, K, X, views[row], pixels, sigma, depth, depth_sigma, row, r)
                # The first guess may be rough: what is a little off may come in.
                limit = 4.0 * gate if attempt == 0 else gate
                keep = pixel <= limit and along <= limit
                changed = changed or keep != (used[row] == 1)
                used[row] = 1 if keep else 0
                if keep:
                    count += 2 if depth[row] > 0.0 else 1
            sound = count >= 2
            if not sound or not changed:
                break
            sound = refine(
                T, K, X, views, pixels, sigma, depth, depth_sigma, begin, end, used, huber, H, b
            )
            if not sound:
                break
        if not sound:
            for row in range(begin, end):
                used[row] = 0
            continue
        # Huber would count what it made light of as less information; all used are within the gate.
        normal_equations(
            T, K, X, views, pixels, sigma_shared, depth, depth_sigma, begin, end, used, 1e9, H, b
        )
        smallest = 1.0
        for i in range(begin, end):
            for j in range(i + 1, end):
                if used[i] and used[j]:
                    cosine = rays[i, 0] * rays[j, 0] + rays[i, 1] * rays[j, 1]
                    smallest = min(smallest, cosine + rays[i, 2] * rays[j, 2])
        parallax[track] = math.acos(max(-1.0, smallest))
        for i in range(3):
            xyz[track, i] = X[i]
            for j in range(i + 1):
                information[track, i, j] = H[i, j]
