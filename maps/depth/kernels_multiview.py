# SPDX-License-Identifier: Apache-2.0
"""Depths of chosen pixels: refined in derotated neighbours, checked against their depths."""

import math

import numpy as np

from edge.kernel import kernel

TRIALS = 8  # inverse depths tried at once: the lanes of the loops
_REACH = 2
_COUNT = np.float32(25.0)  # pixels of a patch
_CAP = np.float32(0.7)  # of 1 - correlation: a neighbour that sees something else says no more
_SUPPORT = np.float32(0.3)  # below it a neighbour sees the same
_FLAT = np.float32(4.0)  # [grey^2] a patch of less variance tells nothing
_NOISE_GREY = np.float32(4.0)  # of a pixel between two images: noise, resampling, gloss
_CORNER_PX = np.float32(0.25)  # what perspective and interpolation do to an edge
_PULL = np.float32(0.03)  # of 1 - correlation, at the ends of the search: where edges say nothing
_START = np.float32(0.5)  # deviation of the start, in parts of the reach
_ONE, _HALF, _TWO = np.float32(1.0), np.float32(0.5), np.float32(2.0)


@kernel
def refine(image, others, valid, shifts, pixels, start, reach, rho, sigma, cost, support):  # type: ignore[no-untyped-def]
    """Move inverse depths to where 5x5 patches correlate best over all neighbours.

    image    (h, w)       float32  reference
    others   (n, h2, w2)  float32  derotated neighbours
    valid    (n, h2, w2)  uint8
    shifts   (n, 7)       float32  fx tx, fy ty, tz, cx, cy, and the margins of `others`
    pixels   (m, 2)       int32    u, v, 3 px inside of the image
    start    (m,)         float32
    reach    float32      how far from `start` to search
    rho      (m,)         float32, out; 0 where nothing fits
    sigma    (m,)         float32, out  standard deviation that the grey values allow
    cost     (m,)         float32, out  mean of 1 - correlation
    support  (m,)         uint8, out    neighbours that agree
    """
    n, height2, width2 = others.shape
    flat, flat_valid = others.reshape(-1), valid.reshape(-1)
    x, y, a = (
        np.empty(TRIALS, np.float32),
        np.empty(TRIALS, np.float32),
        np.empty(TRIALS, np.float32),
    )
    sb, sbb, sab = (
        np.empty(TRIALS, np.float32),
        np.empty(TRIALS, np.float32),
        np.empty(TRIALS, np.float32),
    )
    total, trial = np.empty(TRIALS, np.float32), np.empty(TRIALS, np.float32)
    each = np.empty((n, TRIALS), np.float32)
    for i in range(len(pixels)):
        u, v = pixels[i, 0], pixels[i, 1]
        rho[i], sigma[i], cost[i], support[i] = 0.0, 0.0, _ONE, 0
        if start[i] <= 0.0:
            continue
        sa, saa, gxx, gxy, gyy = _patch(image, u, v)
        variance = saa - sa * sa / _COUNT
        if variance < _COUNT * _FLAT:
            continue
        step = _TWO * reach / np.float32(TRIALS - 1)
        for k in range(TRIALS):
            trial[k] = max(start[i] - reach + step * np.float32(k), np.float32(1e-6))
            total[k] = 0.0
        seen = 0
        information = np.float32(0.0)
        for j in range(n):
            cx, cy = shifts[j, 3], shifts[j, 4]
            du, dv = np.float32(u) - cx, np.float32(v) - cy
            inside = True
            for k in range(TRIALS):
                a[k] = _ONE / max(_ONE + trial[k] * shifts[j, 2], np.float32(0.2))
                x[k] = (du + trial[k] * shifts[j, 0]) * a[k] + cx + shifts[j, 5]
                y[k] = (dv + trial[k] * shifts[j, 1]) * a[k] + cy + shifts[j, 6]
            for k in range(TRIALS):
                room = _TWO * a[k] + _ONE
                inside &= (x[k] >= room) & (y[k] >= room)
                inside &= x[k] < np.float32(width2 - 2) - room
                inside &= y[k] < np.float32(height2 - 2) - room
            if not inside:
                continue
            middle = np.int32(y[TRIALS // 2]) * width2 + np.int32(x[TRIALS // 2])
            if flat_valid[j * height2 * width2 + middle] == 0:
                continue
            for k in range(TRIALS):
                sb[k], sbb[k], sab[k] = 0.0, 0.0, 0.0
            base = np.int32(j * height2 * width2)
            for pv in range(-_REACH, _REACH + 1):
                for pu in range(-_REACH, _REACH + 1):
                    own = image[v + pv, u + pu]
                    ou, ov = np.float32(pu), np.float32(pv)
                    for k in range(TRIALS):
                        xx, yy = x[k] + a[k] * ou, y[k] + a[k] * ov
                        left, top = np.int32(xx), np.int32(yy)
                        fu, fv = xx - np.float32(left), yy - np.float32(top)
                        at = base + top * np.int32(width2) + left
                        upper = flat[at] + fu * (flat[at + 1] - flat[at])
                        at += np.int32(width2)
                        lower = flat[at] + fu * (flat[at + 1] - flat[at])
                        b = upper + fv * (lower - upper)
                        sb[k] += b
                        sbb[k] += b * b
                        sab[k] += own * b
            seen += 1
            for k in range(TRIALS):
                spread = max(sbb[k] - sb[k] * sb[k] / _COUNT, _FLAT * _COUNT)
                c = (sab[k] - sa * sb[k] / _COUNT) / math.sqrt(spread * variance)
                each[j, k] = _ONE - c
                total[k] += min(_ONE - c, _CAP)
            # How fast the patch moves over the neighbour, along its gradients.
            scale = a[TRIALS // 2] * a[TRIALS // 2]
            mx = (shifts[j, 0] - du * shifts[j, 2]) * scale
            my = (shifts[j, 1] - dv * shifts[j, 2]) * scale
            best = each[j, 0]
            for k in range(1, TRIALS):
                best = min(best, each[j, k])
            if best < _SUPPORT:
                support[i] += 1
                information += gxx * mx * mx + _TWO * gxy * mx * my + gyy * my * my
        if support[i] == 0:
            continue
        for k in range(TRIALS):
            off = (trial[k] - start[i]) / reach
            total[k] += _PULL * np.float32(seen) * off * off
        best_k = 0
        for k in range(TRIALS):
            if total[k] < total[best_k]:
                best_k = k
        if best_k == 0 or best_k == TRIALS - 1:
            continue
        low, centre, high = total[best_k - 1], total[best_k], total[best_k + 1]
        curve = low - _TWO * centre + high
        offset = _HALF * (low - high) / curve if curve > 0.0 else np.float32(0.0)
        rho[i] = trial[best_k] + offset * step
        cost[i] = centre / np.float32(seen)
        # Steep edges are not known better than a share of a pixel; flat ones by the start alone.
        noise = _NOISE_GREY * _NOISE_GREY + _CORNER_PX * _CORNER_PX * (gxx + gyy)
        known = information / noise + _ONE / (_START * reach * _START * reach)
        sigma[i] = _ONE / math.sqrt(known)


@kernel
def _patch(image, u, v):  # type: ignore[no-untyped-def]
    """Sums over a 5x5 patch: grey, grey^2, and its gradients' products."""
    sa = saa = gxx = gxy = gyy = np.float32(0.0)
    for pv in range(-_REACH, _REACH + 1):
        for pu in range(-_REACH, _REACH + 1):
            grey = image[v + pv, u + pu]
            gx = _HALF * (image[v + pv, u + pu + 1] - image[v + pv, u + pu - 1])
            gy = _HALF * (image[v + pv + 1, u + pu] - image[v + pv - 1, u + pu])
            sa += grey
            saa += grey * grey
            gxx += gx * gx
            gxy += gx * gy
            gyy += gy * gy
    return sa, saa, gxx, gxy, gyy


@kernel
def agree(pixels, rho, K, T, K_other, other, tolerance, agreeing, visible):  # type: ignore[no-untyped-def]
    """Count up for each pixel whether another view's depth map sees the same surface.

    pixels     (m, 2)  int32    u, v of the reference
    rho        (m,)    float32  inverse depths; those of 0 are left out
    K, K_other (4,)    float64  fx fy cx cy; the latter of the depth map
    T          (4, 4)  float64  takes points of the reference to the other camera
    other      (h, w)  float32  inverse depths; 0 where unknown
    tolerance  float64 relative difference of inverse depths that is agreement
    agreeing   (m,)    uint8, out  one more where it does
    visible    (m,)    uint8, out  one more where the other map has a depth that is not in front
    """
    height, width = other.shape
    for i in range(len(pixels)):
        if rho[i] <= 0.0:
            continue
        z = 1.0 / rho[i]
        x, y = (pixels[i, 0] - K[2]) / K[0] * z, (pixels[i, 1] - K[3]) / K[1] * z
        xo = T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]
        yo = T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]
        zo = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
        if zo <= 1e-9:
            continue
        u, v = K_other[0] * xo / zo + K_other[2] + 0.5, K_other[1] * yo / zo + K_other[3] + 0.5
        if not (1.0 <= u < width - 1 and 1.0 <= v < height - 1):
            continue
        # The nearest of 3x3: at an edge the pixel beside it may be the one that was meant.
        best, here = 1e30, other[int(v), int(u)]
        for dv in range(-1, 2):
            for du in range(-1, 2):
                r = other[int(v) + dv, int(u) + du]
                if r > 0.0:
                    best = min(best, abs(r * zo - 1.0))
        if best < tolerance:
            agreeing[i] += 1
            visible[i] += 1
        elif here > 0.0 and here * zo < 1.0:
            visible[i] += 1
