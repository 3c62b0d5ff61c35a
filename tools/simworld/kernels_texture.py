# SPDX-License-Identifier: Apache-2.0
"""Textures: mip levels, filtered over what a pixel covers of them."""

import math
from typing import TypeAlias

from edge.kernel import inline_kernel
from edge.types import I32
from tools.simworld.kernels_trace import U32

Colour: TypeAlias = tuple[float, float, float]
MAX_PROBES = 6  # along the longer axis of a pixel's footprint


@inline_kernel
def sample_level(texels: U32, first: int, log_w: int, log_h: int, u: float, v: float) -> Colour:
    """Bilinear BGR [0, 255] of one texture level at texel coordinates; wraps around."""
    x, y = math.floor(u), math.floor(v)
    a, b = u - x, v - y
    mask_u, mask_v = (1 << log_w) - 1, (1 << log_h) - 1
    x0, y0 = int(x) & mask_u, int(y) & mask_v
    x1, y1 = (x0 + 1) & mask_u, (y0 + 1) & mask_v
    i00, i01 = first + (y0 << log_w) + x0, first + (y0 << log_w) + x1
    i10, i11 = first + (y1 << log_w) + x0, first + (y1 << log_w) + x1
    w00, w01, w10, w11 = (1.0 - a) * (1.0 - b), a * (1.0 - b), (1.0 - a) * b, a * b
    c00, c01, c10, c11 = texels[i00], texels[i01], texels[i10], texels[i11]
    return (
        w00 * (c00 & 255) + w01 * (c01 & 255) + w10 * (c10 & 255) + w11 * (c11 & 255),
        w00 * ((c00 >> 8) & 255)
        + w01 * ((c01 >> 8) & 255)
        + w10 * ((c10 >> 8) & 255)
        + w11 * ((c11 >> 8) & 255),
        w00 * (c00 >> 16) + w01 * (c01 >> 16) + w10 * (c10 >> 16) + w11 * (c11 >> 16),
    )


@inline_kernel
def sample_trilinear(
    textures: I32, texels: U32, texture: int, u: float, v: float, lod: float
) -> Colour:
    """BGR [0, 255] at level-0 texel coordinates, between two mip levels."""
    first = textures[texture, 0]
    log_w, log_h = textures[texture, 1], textures[texture, 2]
    last = textures[texture, 3] - 1
    lod = min(max(lod, 0.0), float(last))
    level = int(lod)
    part = lod - level
    for i in range(level):
        first += 1 << (max(log_w - i, 0) + max(log_h - i, 0))
    shrink = 1.0 / (1 << level)
    lw, lh = max(log_w - level, 0), max(log_h - level, 0)
    c = sample_level(texels, first, lw, lh, (u + 0.5) * shrink - 0.5, (v + 0.5) * shrink - 0.5)
    if part < 1e-3 or level >= last:
        return c
    first += 1 << (lw + lh)
    shrink *= 0.5
    lw, lh = max(lw - 1, 0), max(lh - 1, 0)
    e = sample_level(texels, first, lw, lh, (u + 0.5) * shrink - 0.5, (v + 0.5) * shrink - 0.5)
    return (
        c[0] + part * (e[0] - c[0]),
        c[1] + part * (e[1] - c[1]),
        c[2] + part * (e[2] - c[2]),
    )


@inline_kernel
def sample_footprint(
    textures: I32,
    texels: U32,
    texture: int,
    u: float,
    v: float,
    ux: float,
    uy: float,
    vx: float,
    vy: float,
) -> Colour:
    """BGR [0, 255] averaged over the parallelogram that a pixel covers on a texture.

    (ux, vx) and (uy, vy) are the texel steps to the next pixel right and down.
    Several isotropic probes lie along the footprint's longer axis.
    """
    p, q, r = ux * ux + uy * uy, ux * vx + uy * vy, vx * vx + vy * vy
    root = math.sqrt((0.5 * (p - r)) ** 2 + q * q)
    major = math.sqrt(0.5 * (p + r) + root)
    minor = math.sqrt(max(0.5 * (p + r) - root, 0.0))
    n = int(min(math.ceil(major / max(minor, 1e-9) - 0.25), float(MAX_PROBES)))
    if major <= 1.0 or n <= 1:
        return sample_trilinear(textures, texels, texture, u, v, math.log2(max(major, 1.0)))
    width = max(minor, major / n)
    n = int(min(float(n), math.ceil(major)))
    # the eigenvector of the larger eigenvalue, from the row that is not near zero
    ex, ey = 0.5 * (p - r) + root, q
    if p < r:
        ex, ey = q, 0.5 * (r - p) + root
    length = math.sqrt(ex * ex + ey * ey)
    ex, ey = ex / length * major / n, ey / length * major / n
    lod = math.log2(max(width, 1.0))
    b, g, red = 0.0, 0.0, 0.0
    for i in range(n):
        k = i - 0.5 * (n - 1)
        c = sample_trilinear(textures, texels, texture, u + k * ex, v + k * ey, lod)
        b, g, red = b + c[0], g + c[1], red + c[2]
    return b / n, g / n, red / n
