# SPDX-License-Identifier: Apache-2.0
"""Pixels that several surfaces share: many samples, each surface shaded once."""

import math

import numpy as np

from edge.kernel import inline_kernel, kernel
from edge.types import F32, F64, I32, U8
from tools.simworld.kernels_shade import shade
from tools.simworld.kernels_texture import Colour
from tools.simworld.kernels_trace import FACES, U32, Vec3, hit_primitive, rotate, trace

SAMPLES = 16
# one in each of sixteen rows and columns, so that an upright edge has sixteen steps
SAMPLE_U = (np.arange(SAMPLES) + 0.5) / SAMPLES - 0.5
SAMPLE_V = (np.arange(SAMPLES) * 7 % SAMPLES + 0.5) / SAMPLES - 0.5


@kernel
def mark_edges(key: I32, edge: U8) -> None:
    """Mark pixels with another surface among their eight neighbours; edge (h, w) is out."""
    h, w = key.shape
    for v in range(h):
        for u in range(w):
            here = key[v, u]
            found = 0
            for i in range(max(v - 1, 0), min(v + 2, h)):
                for j in range(max(u - 1, 0), min(u + 2, w)):
                    if key[i, j] != here:
                        found = 1
            edge[v, u] = found


@inline_kernel
def ray_at(rays: F64, u: float, v: float) -> tuple[float, float]:
    """Camera ray (x, y, 1) through a pixel, linear between the table's entries."""
    i = min(max(math.floor(v), 0), rays.shape[0] - 2)
    j = min(max(math.floor(u), 0), rays.shape[1] - 2)
    a, b = u - j, v - i
    x = rays[i, j, 0] + a * (rays[i, j + 1, 0] - rays[i, j, 0])
    y = rays[i, j, 1] + a * (rays[i, j + 1, 1] - rays[i, j, 1])
    x += b * (rays[i + 1, j, 0] - rays[i, j, 0])
    y += b * (rays[i + 1, j, 1] - rays[i, j, 1])
    return x, y


@inline_kernel
def world_ray(rays: F64, R: F64, row: int, u: float, v: float) -> Vec3:
    """Direction in the world of the ray through (u, v), with unit depth."""
    x, y = ray_at(rays, u, v)
    return rotate(R, row, (x, y, 1.0))


@inline_kernel
def colour_at(
    prims: F64,
    faces: F64,
    textures: I32,
    texels: U32,
    light: F32,
    rays: F64,
    R: F64,
    row: int,
    origin: Vec3,
    k: int,
    face: int,
    u: float,
    v: float,
) -> tuple[bool, float, float, float]:
    """Whether primitive k shows this face at (u, v), and its colour there."""
    d = world_ray(rays, R, row, u, v)
    t, hit = hit_primitive(prims, k, origin, d)
    if hit != face:
        return False, 0.0, 0.0, 0.0
    a = world_ray(rays, R, row, u + 1.0, v)
    b = world_ray(rays, R, row, u, v + 1.0)
    right = (a[0] - d[0], a[1] - d[1], a[2] - d[2])
    down = (b[0] - d[0], b[1] - d[1], b[2] - d[2])
    c = shade(prims, faces, textures, texels, light, k, face, t, origin, d, right, down)
    return True, c[0], c[1], c[2]


@kernel
def mix_surfaces(
    prims: F64,
    faces: F64,
    textures: I32,
    texels: U32,
    light: F32,
    rays: F64,
    R: F64,
    origin: Vec3,
    order: I32,
    gap: F64,
    n: int,
    u: int,
    v: int,
    seen: F64,
) -> Colour:
    """Colour of a pixel that several surfaces share, each face shaded once.

    order, gap and n are the tile's candidates as `cull` made them; seen
    (SAMPLES, 6) float64 is scratch: key, count, sums of u and v, first u and v.
    """
    groups = 0
    for s in range(SAMPLES):
        us, vs = u + SAMPLE_U[s], v + SAMPLE_V[s]
        d = world_ray(rays, R, v, us, vs)
        _, k, face = trace(prims, order, gap, n, origin, d)
        if k < 0:
            continue
        key = k * FACES + face
        g = 0
        while g < groups and seen[g, 0] != key:
            g += 1
        if g == groups:
            groups += 1
            seen[g, 0], seen[g, 1], seen[g, 2], seen[g, 3] = float(key), 0.0, 0.0, 0.0
            seen[g, 4], seen[g, 5] = us, vs
        seen[g, 1] += 1.0
        seen[g, 2] += us
        seen[g, 3] += vs
    blue, green, red = 0.0, 0.0, 0.0
    for g in range(groups):
        k, face = int(seen[g, 0]) // FACES, int(seen[g, 0]) % FACES
        count = seen[g, 1]
        um, vm = seen[g, 2] / count, seen[g, 3] / count
        ok, cb, cg, cr = colour_at(
            prims, faces, textures, texels, light, rays, R, v, origin, k, face, um, vm
        )
        if not ok:  # a curved rim: the mean of its samples may miss it
            ok, cb, cg, cr = colour_at(
                prims,
                faces,
                textures,
                texels,
                light,
                rays,
                R,
                v,
                origin,
                k,
                face,
                seen[g, 4],
                seen[g, 5],
            )
        blue, green, red = blue + count * cb, green + count * cg, red + count * cr
    return blue / SAMPLES, green / SAMPLES, red / SAMPLES
