# SPDX-License-Identifier: Apache-2.0
"""Matching of two posed images along the epipolar segments that the poses and depths allow."""

import math

from edge.kernel import inline_kernel, kernel
from edge.relocalise.kernels_bow import hamming

_SAME_CORNER_PX = 4.0  # one corner seen at several octaves is no rival of itself


@inline_kernel
def _segment_distance2(u, v, u0, v0, u1, v1):  # type: ignore[no-untyped-def]
    """Squared distance [px^2] of (u, v) from the segment between two points."""
    du, dv = u1 - u0, v1 - v0
    length2 = du * du + dv * dv
    s = 0.0
    if length2 > 1e-12:
        s = min(1.0, max(0.0, ((u - u0) * du + (v - v0) * dv) / length2))
    ru, rv = u - u0 - s * du, v - v0 - s * dv
    return ru * ru + rv * rv


@inline_kernel
def _end_points(x, y, near, far, R, t, K):  # type: ignore[no-untyped-def]
    """Where the ray (x, y, 1) of camera a goes in image b between two depths, and how it turns.

    Returns whether anything of it is seen, u v of both ends, and the turn of the image [rad].
    """
    fx, fy, cx, cy = K[0], K[1], K[2], K[3]
    a0 = R[0, 0] * x + R[0, 1] * y + R[0, 2]
    a1 = R[1, 0] * x + R[1, 1] * y + R[1, 2]
    a2 = R[2, 0] * x + R[2, 1] * y + R[2, 2]
    # Views that share a corner look the same way, roughly: rays that turn away have no match.
    if a2 < 1e-3:
        return False, 0.0, 0.0, 0.0, 0.0, 0.0
    # Of what lies behind camera b nothing is seen: clip there.
    if a2 * near + t[2] < 1e-3 * near:
        near = (1e-3 * near - t[2]) / a2
        if near >= far:
            return False, 0.0, 0.0, 0.0, 0.0, 0.0
    w = a2 * near + t[2]
    u0, v0 = fx * (a0 * near + t[0]) / w + cx, fy * (a1 * near + t[1]) / w + cy
    u1, v1 = fx * a0 / a2 + cx, fy * a1 / a2 + cy
    if not math.isinf(far):
        w = a2 * far + t[2]
        u1, v1 = fx * (a0 * far + t[0]) / w + cx, fy * (a1 * far + t[1]) / w + cy
    # How the image turns from a to b, from where a ray beside this one goes at infinity.
    du = (R[0, 0] * a2 - a0 * R[2, 0]) * fx
    dv = (R[1, 0] * a2 - a1 * R[2, 0]) * fy
    return True, u0, v0, u1, v1, math.atan2(dv, du)


@inline_kernel
def _first_at_least(pixels, order, axis, value):  # type: ignore[no-untyped-def]
    """Place in `order` (pixels sorted along an axis) of the first that is not below `value`."""
    low, high = 0, order.shape[0]
    while low < high:
        middle = (low + high) // 2
        if pixels[order[middle], axis] < value:
            low = middle + 1
        else:
            high = middle
    return low


@kernel
def match_one_way(  # type: ignore[no-untyped-def]
    rays,
    near,
    far,
    bits_a,
    angle_a,
    sigma_a,
    pixels,
    bits_b,
    angle_b,
    sigma_b,
    orders,
    R,
    t,
    K,
    limits,
    index,
    bits,
    out_b,
    out_distance,
):
    """Overwrite out_b with each feature's best match in the other image, -1 where none is sure.

    rays          (n, 3)   float64  of image a, z = 1
    near, far     (n,)     float64  depths between which the point lies; far may be inf
    bits_a        (n, 4)   uint64   descriptors
    angle_a       (n,)     float32  [rad]
    sigma_a       (n,)     float32  scale of its octave
    pixels        (m, 2)   float32  of image b, ideal
    bits_b angle_b sigma_b (m, ..)  as of a
    orders        (2, m)   int32    rows of image b sorted by u, and by v
    R, t          (3, 3), (3,) float64  take points of camera a to camera b
    K             (4,)     float64  fx fy cx cy of b
    limits        (4,)     float64  radius [px at octave 0], bits, ratio, turn [rad]
    index, bits   (m,)     int32    scratch
    out_b         (n,)     int32, out
    out_distance  (n,)     int32, out; bits
    """
    radius, max_bits, ratio, max_turn = limits[0], limits[1], limits[2], limits[3]
    widest = 0.0
    for j in range(pixels.shape[0]):
        widest = max(widest, float(sigma_b[j]))
    for i in range(rays.shape[0]):
        out_b[i] = -1
        out_distance[i] = 256
        seen, u0, v0, u1, v1, turn = _end_points(rays[i, 0], rays[i, 1], near[i], far[i], R, t, K)
        if not seen:
            continue
        # Walk along the axis on which the band is short.
        axis = 0 if abs(u1 - u0) < abs(v1 - v0) else 1
        low, high = (min(u0, u1), max(u0, u1)) if axis == 0 else (min(v0, v1), max(v0, v1))
        margin = radius * max(float(sigma_a[i]), widest)
        place = _first_at_least(pixels, orders[axis], axis, low - margin)
        found, best, best_at = 0, 257, -1
        while place < pixels.shape[0]:
            j = orders[axis, place]
            place += 1
            if pixels[j, axis] > high + margin:
                break
            u, v = float(pixels[j, 0]), float(pixels[j, 1])
            reach = radius * max(sigma_a[i], sigma_b[j])
            if _segment_distance2(u, v, u0, v0, u1, v1) > reach * reach:
                continue
            off = angle_b[j] - angle_a[i] - turn
            off -= 2.0 * math.pi * math.floor(off / (2.0 * math.pi) + 0.5)
            if abs(off) > max_turn:
                continue
            distance = hamming(bits_a, i, bits_b, j)
            index[found] = j
            bits[found] = distance
            found += 1
            if distance < best or (distance == best and j < best_at):
                best, best_at = distance, j
        if best > max_bits:
            continue
        second = 257
        for k in range(found):
            j = index[k]
            du = float(pixels[j, 0]) - float(pixels[best_at, 0])
            dv = float(pixels[j, 1]) - float(pixels[best_at, 1])
            apart = _SAME_CORNER_PX * max(sigma_b[j], sigma_b[best_at])
            if du * du + dv * dv > apart * apart:
                second = min(second, bits[k])
        if best <= ratio * second:
            out_b[i] = best_at
            out_distance[i] = best
