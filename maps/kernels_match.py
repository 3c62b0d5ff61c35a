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
    R, t          (3, 3), (3,) float64  take points of camera a to camera b
    K             (4,)     float64  fx fy cx cy of b
    limits        (4,)     float64  radius [px at octave 0], bits, ratio, turn [rad]
    index, bits   (m,)     int32    scratch
    out_b         (n,)     int32, out
    out_distance  (n,)     int32, out; bits
    """
    fx, fy, cx, cy = K[0], K[1], K[2], K[3]
    radius, max_bits, ratio, max_turn = limits[0], limits[1], limits[2], limits[3]
    for i in range(rays.shape[0]):
        out_b[i] = -1
        out_distance[i] = 256
        x, y = rays[i, 0], rays[i, 1]
        a0 = R[0, 0] * x + R[0, 1] * y + R[0, 2]
        a1 = R[1, 0] * x + R[1, 1] * y + R[1, 2]
        a2 = R[2, 0] * x + R[2, 1] * y + R[2, 2]
        z0, z1 = near[i], far[i]
        # Of what lies behind camera b nothing is seen: clip there.
        if a2 * z0 + t[2] < 1e-3 * z0:
            if a2 <= 1e-6:
                continue
            z0 = (1e-3 * z0 - t[2]) / a2
            if z0 >= z1:
                continue
        w0 = a2 * z0 + t[2]
        u0, v0 = fx * (a0 * z0 + t[0]) / w0 + cx, fy * (a1 * z0 + t[1]) / w0 + cy
        if math.isinf(z1):
            if a2 < 1e-3:
                continue
            u1, v1 = fx * a0 / a2 + cx, fy * a1 / a2 + cy
        else:
            w1 = a2 * z1 + t[2]
            if w1 <= 1e-3 * z0:
                continue
            u1, v1 = fx * (a0 * z1 + t[0]) / w1 + cx, fy * (a1 * z1 + t[1]) / w1 + cy
        # How the image turns from a to b, from where a ray beside this one goes at infinity.
        if a2 < 1e-3:
            continue
        du = (R[0, 0] * a2 - a0 * R[2, 0]) * fx
        dv = (R[1, 0] * a2 - a1 * R[2, 0]) * fy
        turn = math.atan2(dv, du)
        low_u, high_u = min(u0, u1), max(u0, u1)
        low_v, high_v = min(v0, v1), max(v0, v1)
        found, best, best_at = 0, 257, -1
        for j in range(pixels.shape[0]):
            reach = radius * max(sigma_a[i], sigma_b[j])
            u, v = float(pixels[j, 0]), float(pixels[j, 1])
            if u < low_u - reach or u > high_u + reach or v < low_v - reach or v > high_v + reach:
                continue
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
            if distance < best:
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
