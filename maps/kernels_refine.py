# SPDX-License-Identifier: Apache-2.0
"""What a point costs its observations, and the step to where it costs least."""

import math

import numpy as np

from edge.kernel import inline_kernel, kernel

_MAX_STEPS = 12
_MIN_DEPTH = 1e-6


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
def chi2(T, K, X, view, pixels, sigma, depth, depth_sigma, row, r):  # type: ignore[no-untyped-def]
    """Squared normalised residuals of one observation: of its pixel, and of its depth (or 0)."""
    if not _residual(T, K, X, view, pixels, row, r):
        return 1e18, 0.0
    pixel = (r[0] * r[0] + r[1] * r[1]) / (sigma[row] * sigma[row])
    if depth[row] <= 0.0:
        return pixel, 0.0
    off = (r[4] - depth[row]) / depth_sigma[row]
    return pixel, off * off


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
def normal_equations(  # type: ignore[no-untyped-def]
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
        pixel, along2 = chi2(T, K, X, views[row], pixels, sigma, depth, depth_sigma, row, r)
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
def refine(  # type: ignore[no-untyped-def]
    T, K, X, views, pixels, sigma, depth, depth_sigma, begin, end, used, huber, H, b
):
    """Move X to the least robust cost (Levenberg-Marquardt); leave H there. Return success."""
    damped, step, trial = np.empty((3, 3)), np.empty(3), np.empty(3)
    cost = normal_equations(
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
        new_cost = normal_equations(
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
            normal_equations(
                T, K, X, views, pixels, sigma, depth, depth_sigma, begin, end, used, huber, H, b
            )
            if damping > 1e6:
                return True
    return True
