# SPDX-License-Identifier: Apache-2.0
"""Broken pieces of edges joined, and edges measured to a fraction of a pixel."""

import math

import numpy as np

from edge.kernel import inline_kernel, kernel
from edge.types import F64, U8

_STEP = 0.5  # between samples across an edge [px]
_SAMPLES = 13  # across: three pixels to either side
_MAX_PLACES = 48  # along
_MIN_PLACES = 6
_ROUNDS = 2  # of profiles about the line that the last round found
_FIT_ROUNDS = 5
_MIN_SCALE_PX = 0.15  # of residuals that count in full
_MIN_SHARE = 0.5  # of places where there must be an edge
_PARTS = 6  # of an edge, each of which may be off by itself


@kernel
def join(ends: F64, across_px: float, cosine: float, gap_share: float, alive: U8) -> int:
    """Join pieces of one edge in place; return how many remain.

    ends   (n, 4)  float64  u0 v0 u1 v1, longest first, all with the brighter side on one hand
    alive  (n,)    uint8, out  0 where a piece went into a longer one
    """
    n = int(ends.shape[0])
    alive[:] = 1
    left = n
    for i in range(n):
        if alive[i] == 0:
            continue
        again = True
        while again:
            again = False
            for j in range(n):
                if j == i or alive[j] == 0:
                    continue
                if _join_pair(ends, i, j, across_px, cosine, gap_share):
                    alive[j] = 0
                    left = left - 1
                    again = True
    return left


@inline_kernel
def _join_pair(ends, i, j, across_px, cosine, gap_share):  # type: ignore[no-untyped-def]
    """Stretch segment i over j if both are pieces of one edge."""
    u0, v0, u1, v1 = ends[i, 0], ends[i, 1], ends[i, 2], ends[i, 3]
    a0, b0, a1, b1 = ends[j, 0], ends[j, 1], ends[j, 2], ends[j, 3]
    length, other = math.hypot(u1 - u0, v1 - v0), math.hypot(a1 - a0, b1 - b0)
    if not (length > 0.0 and other > 0.0):
        return False
    du, dv = (u1 - u0) / length, (v1 - v0) / length
    if du * (a1 - a0) + dv * (b1 - b0) < cosine * other:
        return False
    s0, s1 = du * (a0 - u0) + dv * (b0 - v0), du * (a1 - u0) + dv * (b1 - v0)
    if max(s0 - length, -s1) > gap_share * min(length, other):
        return False
    w0, w1 = du * (b0 - v0) - dv * (a0 - u0), du * (b1 - v0) - dv * (a1 - u0)
    if abs(w0) > across_px or abs(w1) > across_px:
        return False
    # The line through both, each by its length: least squares of the offsets of four ends.
    total = 2.0 * (length + other)
    mean_s = (length * length + other * (s0 + s1)) / total
    mean_w = other * (w0 + w1) / total
    ss = length * (mean_s * mean_s + (length - mean_s) ** 2)
    ss += other * ((s0 - mean_s) ** 2 + (s1 - mean_s) ** 2)
    sw = length * (-mean_w) * (length - 2.0 * mean_s)
    sw += other * ((s0 - mean_s) * (w0 - mean_w) + (s1 - mean_s) * (w1 - mean_w))
    slope = sw / ss
    low, high = min(0.0, s0), max(length, s1)
    w_low, w_high = mean_w + slope * (low - mean_s), mean_w + slope * (high - mean_s)
    ends[i, 0], ends[i, 1] = u0 + low * du - w_low * dv, v0 + low * dv + w_low * du
    ends[i, 2], ends[i, 3] = u0 + high * du - w_high * dv, v0 + high * dv + w_high * du
    return True


@inline_kernel
def _grey(image, u, v):  # type: ignore[no-untyped-def]
    """Bilinear grey value, at places that are inside."""
    x, y = int(u), int(v)
    fu, fv = u - x, v - y
    top = (1.0 - fu) * image[y, x] + fu * image[y, x + 1]
    low = (1.0 - fu) * image[y + 1, x] + fu * image[y + 1, x + 1]
    return (1.0 - fv) * top + fv * low


@kernel
def measure(image: U8, ends: F64, min_contrast: float, sigma: F64) -> int:
    """Move segments onto the steepest places of the edges that they lie along, in place.

    image  (h, w)  uint8
    ends   (n, 4)  float64  within two pixels or so of an edge; in and out
    sigma  (n,)    float64, out  of either end across the line [px]; infinite: no edge there

    Returns how many edges were found.
    """
    offset, place, weight = np.empty(_MAX_PLACES), np.empty(_MAX_PLACES), np.empty(_MAX_PLACES)
    profile, slope = np.empty(_SAMPLES), np.empty(_SAMPLES)
    found = 0
    for i in range(ends.shape[0]):
        sigma[i] = math.inf
        good = True
        for _ in range(_ROUNDS):
            good = good and _measure_one(
                image, ends, i, min_contrast, sigma, offset, place, weight, profile, slope
            )
        if good:
            found += 1
        else:
            sigma[i] = math.inf
    return found


@kernel
def _measure_one(
    image: U8,
    ends: F64,
    i: int,
    min_contrast: float,
    sigma: F64,
    offset: F64,
    place: F64,
    weight: F64,
    profile: F64,
    slope: F64,
) -> bool:
    """One round of `measure` for segment i."""
    height, width = image.shape
    u0, v0 = ends[i, 0], ends[i, 1]
    length = math.hypot(ends[i, 2] - u0, ends[i, 3] - v0)
    if not length > 1.0:
        return False
    du, dv = (ends[i, 2] - u0) / length, (ends[i, 3] - v0) / length
    places = min(max(int(0.5 * length), _MIN_PLACES), _MAX_PLACES)
    half = _SAMPLES // 2
    count, side = 0, 0.0
    for turn in range(2):  # first which side is brighter, then where the edge is
        for k in range(places):
            s = length * (k + 0.5) / places
            cu, cv = u0 + s * du, v0 + s * dv
            reach = half * _STEP + 1.0
            if not (reach < cu < width - 1 - reach and reach < cv < height - 1 - reach):
                continue
            for j in range(_SAMPLES):
                o = (j - half) * _STEP
                profile[j] = _grey(image, cu - o * dv, cv + o * du)
            if turn == 0:
                side += profile[half + 3] - profile[half - 3]
                continue
            best = 2
            for j in range(2, _SAMPLES - 2):
                slope[j] = math.copysign(1.0, side) * (profile[j + 1] - profile[j - 1])
                if slope[j] > slope[best]:
                    best = j
            contrast = math.copysign(1.0, side) * (profile[best + 2] - profile[best - 2])
            if contrast < min_contrast:
                continue
            first, last = max(best - 2, 2), min(best + 2, _SAMPLES - 3)
            energy, moment = 0.0, 0.0
            for j in range(first, last + 1):
                g = max(slope[j], 0.0) ** 2
                energy += g
                moment += g * (j - half) * _STEP
            offset[count], place[count] = moment / energy, s
            count += 1
    if count < _MIN_PLACES or count < _MIN_SHARE * places:
        return False
    a, b, scale = _fit(place, offset, weight, count, 0.5 * length)
    low, high = length, 0.0
    for k in range(count):
        offset[k] -= a + b * (place[k] - 0.5 * length)
        weight[k] = 1.0 if abs(offset[k]) < 3.0 * scale else 0.0
        if weight[k] > 0.0:
            low, high = min(low, place[k]), max(high, place[k])
    inside, variance = _scatter(place, offset, weight, count, length)
    if inside < _MIN_PLACES or inside < _MIN_SHARE * places:
        return False
    low, high = low - 0.5 * length / places, high + 0.5 * length / places
    w_low, w_high = a + b * (low - 0.5 * length), a + b * (high - 0.5 * length)
    ends[i, 0], ends[i, 1] = u0 + low * du - w_low * dv, v0 + low * dv + w_low * du
    ends[i, 2], ends[i, 3] = u0 + high * du - w_high * dv, v0 + high * dv + w_high * du
    # The middle of a fit has the variance of one place over their number, each end four times it.
    sigma[i] = 2.0 * math.sqrt(variance / inside)
    return True


@inline_kernel
def _scatter(place, offset, weight, count, length):  # type: ignore[no-untyped-def]
    """How many places count, and the variance of one, by itself or by its part of the edge.

    Neighbours err alike where the edge is bent, or two were joined: whole parts of it are off then.
    """
    inside, squares, parts, together = 0.0, 0.0, 0, 0.0
    for part in range(_PARTS):
        many, total = 0.0, 0.0
        for k in range(count):
            if weight[k] > 0.0 and min(int(_PARTS * place[k] / length), _PARTS - 1) == part:
                many += 1.0
                total += offset[k]
                squares += offset[k] * offset[k]
        if many > 0.0:
            inside += many
            parts += 1
            together += total * total / many
    variance = squares / max(inside - 2.0, 1.0)
    if parts > 2:
        variance = max(variance, together / (parts - 2))
    return inside, variance


@inline_kernel
def _fit(place, offset, weight, count, middle):  # type: ignore[no-untyped-def]
    """Robust line `a + b (place - middle)` through offsets, and the scale of its residuals."""
    a, b, scale = 0.0, 0.0, 1.0
    for k in range(count):
        weight[k] = 1.0
    for _ in range(_FIT_ROUNDS):
        w0, w1, w2, y0, y1 = 1e-12, 0.0, 0.0, 0.0, 0.0
        for k in range(count):
            x = place[k] - middle
            w0 += weight[k]
            w1 += weight[k] * x
            w2 += weight[k] * x * x
            y0 += weight[k] * offset[k]
            y1 += weight[k] * x * offset[k]
        det = max(w0 * w2 - w1 * w1, 1e-12)
        a, b = (w2 * y0 - w1 * y1) / det, (w0 * y1 - w1 * y0) / det
        squares, total = 0.0, 1e-12
        for k in range(count):
            r = offset[k] - a - b * (place[k] - middle)
            squares += weight[k] * r * r
            total += weight[k]
        scale = max(math.sqrt(squares / total), _MIN_SCALE_PX)
        for k in range(count):
            r = (offset[k] - a - b * (place[k] - middle)) / (2.0 * scale)
            weight[k] = 1.0 / (1.0 + r * r) ** 2
    return a, b, scale
