# SPDX-License-Identifier: Apache-2.0
"""A point from its views: first guess by pairs, robust Gauss-Newton, covariance."""

import math

import numpy as np

from edge.kernel import inline_kernel, kernel

_MAX_GUESSES = 24  # pairs of views tried for the first guess
_MAX_STEPS = 12
_MIN_DEPTH = 1e-6


@inline_kernel
def _midpoint(c0, r0, c1, r1, X):  # type: ignore[no-untyped-def]
    """Write to X (3,) the point nearest to two rays (centres c, unit directions r)."""
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
    return s0 > 0.0 and s1 > 0.0


@inline_kernel
def _residual(T, K, X, view, pixels, row, r):  # type: ignore[no-untyped-def]
    """Write to r what a view sees of X: residual u v [px], then x y z in its camera."""
    x = T[view, 0, 0] * X[0] + T[view, 0, 1] * X[1] + T[view, 0, 2] * X[2] + T[view, 0, 3]
    y = T[view, 1, 0] * X[0] + T[view, 1, 1] * X[1] + T[view, 1, 2] * X[2] + T[view, 1, 3]
    z = T[view, 2, 0] * X[0] + T[view, 2, 1] * X[1] + T[view, 2, 2] * X[2] + T[view, 2, 3]
    r[2], r[3], r[4] = x, y, z
    if z < _MIN_DEPTH:
        return False
    r[0] = K[view, 0] * x / z + K[view, 2] - pixels[row, 0]
    r[1] = K[view, 1] * y / z + K[view, 3] - pixels[row, 1]
    return True


@inline_kernel
def _chi2(T, K, X, view, pixels, sigma, depth, depth_sigma, row, r):  # type: ignore[no-untyped-def]
    """Squared normalised residuals of one observation: of its pixel, and of its depth (or 0)."""
    if not _residual(T, K, X, view, pixels, row, r):
        return 1e18, 0.0
    pixel = (r[0] * r[0] + r[1] * r[1]) / (sigma[row] * sigma[row])
    if depth[row] <= 0.0:
        return pixel, 0.0
    off = (r[4] - depth[row]) / depth_sigma[row]
    return pixel, off * off


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
            pixel, along = _chi2(T, K, trial, views[row], pixels, sigma, depth, depth_sigma, row, r)
            cost += min(pixel, gate) + min(along, gate)
        if cost < best_cost:
            best_cost = cost
            for k in range(3):
                X[k] = trial[k]
    return best_cost < 1e300


@inline_kernel
def _solve3(H, b, out):  # type: ignore[no-untyped-def]
    """Write to out (3,) the solution of H x = b by Cholesky; return whether H is positive."""
    l00 = H[0, 0]
    if l00 <= 0.0:
        return False
    l00 = math.sqrt(l00)
    l10, l20 = H[1, 0] / l00, H[2, 0] / l00
    l11 = H[1, 1] - l10 * l10
    if l11 <= 0.0:
        return False
    l11 = math.sqrt(l11)
    l21 = (H[2, 1] - l20 * l10) / l11
    l22 = H[2, 2] - l20 * l20 - l21 * l21
    if l22 <= 0.0:
        return False
    l22 = math.sqrt(l22)
    y0 = b[0] / l00
    y1 = (b[1] - l10 * y0) / l11
    y2 = (b[2] - l20 * y0 - l21 * y1) / l22
    out[2] = y2 / l22
    out[1] = (y1 - l21 * out[2]) / l11
    out[0] = (y0 - l10 * out[1] - l20 * out[2]) / l00
    return True


@inline_kernel
def _add_rows(T, K, view, r, weight, along, weight_along, H, b):  # type: ignore[no-untyped-def]
    """Add one observation to the normal equations H (3, 3), b (3,) of the step -H^-1 b."""
    inverse = 1.0 / r[4]
    for row in range(3):
        if row == 2 and weight_along == 0.0:
            continue
        j0, j1, j2 = 0.0, 0.0, 0.0
        value, w = along, weight_along
        if row < 2:
            focal = K[view, row]
            slope = r[2 + row] * inverse
            j0 = focal * inverse * (T[view, row, 0] - slope * T[view, 2, 0])
            j1 = focal * inverse * (T[view, row, 1] - slope * T[view, 2, 1])
            j2 = focal * inverse * (T[view, row, 2] - slope * T[view, 2, 2])
            value, w = r[row], weight
        else:
            j0, j1, j2 = T[view, 2, 0], T[view, 2, 1], T[view, 2, 2]
        b[0] += w * j0 * value
        b[1] += w * j1 * value
        b[2] += w * j2 * value
        H[0, 0] += w * j0 * j0
        H[1, 0] += w * j1 * j0
        H[1, 1] += w * j1 * j1
        H[2, 0] += w * j2 * j0
        H[2, 1] += w * j2 * j1
        H[2, 2] += w * j2 * j2


@kernel
def _normal_equations(  # type: ignore[no-untyped-def]
    T, K, X, views, pixels, sigma, depth, depth_sigma, begin, end, used, huber, H, b
):
    """Overwrite H, b at X over the used observations, weighted after Huber; return the cost."""
    r = np.empty(5)
    H[:] = 0.0
    b[:] = 0.0
    cost = 0.0
    for row in range(begin, end):
        if used[row] == 0:
            continue
        pixel, along2 = _chi2(T, K, X, views[row], pixels, sigma, depth, depth_sigma, row, r)
        if pixel > 1e17:
            return 1e300
        norm = math.sqrt(pixel)
        weight = min(1.0, huber / max(norm, 1e-12))
        cost += pixel if norm <= huber else huber * (2.0 * norm - huber)
        along, weight_along = 0.0, 0.0
        if depth[row] > 0.0:
            norm = math.sqrt(along2)
            weight_along = min(1.0, huber / max(norm, 1e-12))
            weight_along /= depth_sigma[row] * depth_sigma[row]
            cost += along2 if norm <= huber else huber * (2.0 * norm - huber)
            along = r[4] - depth[row]
        weight /= sigma[row] * sigma[row]
        _add_rows(T, K, views[row], r, weight, along, weight_along, H, b)
    return cost


@kernel
def _refine(  # type: ignore[no-untyped-def]
    T, K, X, views, pixels, sigma, depth, depth_sigma, begin, end, used, huber, H, b
):
    """Move X to the least robust cost (Levenberg-Marquardt); leave H there. Return success."""
    damped, step, trial = np.empty((3, 3)), np.empty(3), np.empty(3)
    cost = _normal_equations(
        T, K, X, views, pixels, sigma, depth, depth_sigma, begin, end, used, huber, H, b
    )
    if cost >= 1e300:
        return False
    damping = 1e-4
    for _ in range(_MAX_STEPS):
        for i in range(3):
            for j in range(3):
                damped[i, j] = H[i, j]
            damped[i, i] *= 1.0 + damping
        if not _solve3(damped, b, step):
            return False
        for k in range(3):
            trial[k] = X[k] - step[k]
        new_cost = _normal_equations(
            T, K, trial, views, pixels, sigma, depth, depth_sigma, begin, end, used, huber, H, b
        )
        if new_cost <= cost:
            done = cost - new_cost < 1e-9 * cost + 1e-12
            cost = new_cost
            damping = max(1e-9, damping * 0.1)
            for k in range(3):
                X[k] = trial[k]
            if done:
                return True
        else:
            damping *= 10.0
            _normal_equations(
                T, K, X, views, pixels, sigma, depth, depth_sigma, begin, end, used, huber, H, b
            )
            if damping > 1e6:
                return True
    return True


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
                pixel, along = _chi2(T, K, X, views[row], pixels, sigma, depth, depth_sigma, row, r)
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
            sound = _refine(
                T, K, X, views, pixels, sigma, depth, depth_sigma, begin, end, used, huber, H, b
            )
            if not sound:
                break
        if not sound:
            for row in range(begin, end):
                used[row] = 0
            continue
        # Huber would count what it made light of as less information; all used are within the gate.
        _normal_equations(
            T, K, X, views, pixels, sigma, depth, depth_sigma, begin, end, used, 1e9, H, b
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
