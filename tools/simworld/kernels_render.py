# SPDX-License-Identifier: Apache-2.0
"""A whole image: tiles with short candidate lists, then colours with smooth edges."""

import math

import numpy as np

from edge.kernel import kernel
from edge.types import F32, F64, I32, U8
from tools.simworld.kernels_edges import SAMPLES, mix_surfaces
from tools.simworld.kernels_shade import begin_face, is_flat, shade, shade_flat
from tools.simworld.kernels_trace import (
    FACES,
    SHAPE,
    Scene,
    cull,
    rotate,
    trace,
)

TILE = 16  # [px]
BLOCK = 64  # [px]; candidates are narrowed down block, then tile
MARGIN = 1e-3  # of a tile, at unit depth: its rows move a little otherwise than its corners


@kernel
def frustum(
    rays: F64, R: F64, p: F64, u0: int, v0: int, u1: int, v1: int, corners: F64, planes: F64
) -> float:
    """Planes (4, 3) around the rays of pixels [u0, u1) x [v0, v1), from row v0's origin.

    corners (4, 3) and planes are out. Returns the slack [m] for the rows' motion.
    """
    left, right, top, bottom = 1e9, -1e9, 1e9, -1e9
    for v in range(v0, v1):  # all of them: a lens bends the edges of a tile
        for u in range(u0, u1):
            left, right = min(left, rays[v, u, 0]), max(right, rays[v, u, 0])
            top, bottom = min(top, rays[v, u, 1]), max(bottom, rays[v, u, 1])
    # half a pixel for the samples around it, and a little for the rows in between
    margin = MARGIN + (right - left) / max(u1 - u0 - 1, 1)
    for i in range(4):
        x = left - margin if i in (0, 3) else right + margin
        y = top - margin if i < 2 else bottom + margin
        c = rotate(R, v0 if i < 2 else v1 - 1, (x, y, 1.0))
        corners[i, 0], corners[i, 1], corners[i, 2] = c
    mx = corners[0, 0] + corners[1, 0] + corners[2, 0] + corners[3, 0]
    my = corners[0, 1] + corners[1, 1] + corners[2, 1] + corners[3, 1]
    mz = corners[0, 2] + corners[1, 2] + corners[2, 2] + corners[3, 2]
    for i in range(4):
        j = (i + 1) % 4
        x = corners[i, 1] * corners[j, 2] - corners[i, 2] * corners[j, 1]
        y = corners[i, 2] * corners[j, 0] - corners[i, 0] * corners[j, 2]
        z = corners[i, 0] * corners[j, 1] - corners[i, 1] * corners[j, 0]
        s = 1.0 / math.sqrt(x * x + y * y + z * z)
        if x * mx + y * my + z * mz < 0.0:
            s = -s
        planes[i, 0], planes[i, 1], planes[i, 2] = x * s, y * s, z * s
    last = v1 - 1
    dx, dy, dz = p[last, 0] - p[v0, 0], p[last, 1] - p[v0, 1], p[last, 2] - p[v0, 2]
    return 1e-4 + math.sqrt(dx * dx + dy * dy + dz * dz)


@kernel
def trace_image(prims: F64, rays: F64, seen: U8, R: F64, p: F64, key: I32, depth: F64) -> None:
    """Surface and depth at every pixel's centre.

    prims (n, 17)  float64  as in `Scene`
    rays  (h + 1, w + 1, 2)  float64  camera rays x, y at z = 1 on whole pixels
    seen  (h, w)  uint8  0 where the lens sees nothing
    R, p  (h, 3, 3), (h, 3)  float64  camera in the world, for each row
    key   (h, w)  int32    out: FACES * primitive + face, -1 for nothing
    depth (h, w)  float64  out: along the optical axis [m], 0 for nothing
    """
    h, w = key.shape
    n = prims.shape[0]
    everything = np.arange(n).astype(np.int32)
    coarse, fine = np.empty(n, np.int32), np.empty(n, np.int32)
    gap = np.empty(n, np.float64)
    corners, planes = np.empty((4, 3)), np.empty((4, 3))
    for block_v in range(0, h, BLOCK):
        for block_u in range(0, w, BLOCK):
            end_v, end_u = min(block_v + BLOCK, h), min(block_u + BLOCK, w)
            slack = frustum(rays, R, p, block_u, block_v, end_u, end_v, corners, planes)
            o = (p[block_v, 0], p[block_v, 1], p[block_v, 2])
            n_coarse = cull(prims, everything, n, o, planes, slack, coarse, gap)
            for v0 in range(block_v, end_v, TILE):
                for u0 in range(block_u, end_u, TILE):
                    v1, u1 = min(v0 + TILE, end_v), min(u0 + TILE, end_u)
                    slack = frustum(rays, R, p, u0, v0, u1, v1, corners, planes)
                    o = (p[v0, 0], p[v0, 1], p[v0, 2])
                    n_fine = cull(prims, coarse, n_coarse, o, planes, slack, fine, gap)
                    for v in range(v0, v1):
                        o = (p[v, 0], p[v, 1], p[v, 2])
                        for u in range(u0, u1):
                            d = rotate(R, v, (rays[v, u, 0], rays[v, u, 1], 1.0))
                            t, k, face = trace(prims, fine, gap, n_fine * seen[v, u], o, d)
                            key[v, u] = k * FACES + face if k >= 0 else -1
                            depth[v, u] = t if k >= 0 else 0.0


@kernel
def shade_image(
    scene: Scene, rays: F64, R: F64, p: F64, key: I32, depth: F64, edge: U8, out: F32
) -> None:
    """Colours of a traced image; out (h, w, 3) float32 BGR [0, 255], unclipped.

    Arguments as `trace_image` and `mark_edges` made them. Pixels on an edge are
    sampled SAMPLES times, the others once: their textures are prefiltered.
    """
    h, w = key.shape
    prims, faces, textures = scene.prims, scene.faces, scene.textures
    texels, light = scene.texels, scene.light
    n = prims.shape[0]
    everything = np.arange(n).astype(np.int32)
    coarse, fine = np.empty(n, np.int32), np.empty(n, np.int32)
    gap, flat = np.empty(n), np.empty(14)
    corners, planes = np.empty((4, 3)), np.empty((4, 3))
    seen = np.empty((SAMPLES, 6))
    for block_v in range(0, h, BLOCK):
        for block_u in range(0, w, BLOCK):
            end_v, end_u = min(block_v + BLOCK, h), min(block_u + BLOCK, w)
            slack = frustum(rays, R, p, block_u, block_v, end_u, end_v, corners, planes)
            o = (p[block_v, 0], p[block_v, 1], p[block_v, 2])
            n_coarse = cull(prims, everything, n, o, planes, slack, coarse, gap)
            for v0 in range(block_v, end_v, TILE):
                for u0 in range(block_u, end_u, TILE):
                    v1, u1 = min(v0 + TILE, end_v), min(u0 + TILE, end_u)
                    n_fine = 0
                    if edge[v0:v1, u0:u1].any():
                        slack = frustum(rays, R, p, u0, v0, u1, v1, corners, planes)
                        o = (p[v0, 0], p[v0, 1], p[v0, 2])
                        n_fine = cull(prims, coarse, n_coarse, o, planes, slack, fine, gap)
                    for v in range(v0, v1):
                        o = (p[v, 0], p[v, 1], p[v, 2])
                        begun = -1
                        for u in range(u0, u1):
                            surface = key[v, u]
                            k, face = surface // FACES, surface % FACES
                            x, y = rays[v, u, 0], rays[v, u, 1]
                            right = (rays[v, u + 1, 0] - x, rays[v, u + 1, 1] - y)
                            down = (rays[v + 1, u, 0] - x, rays[v + 1, u, 1] - y)
                            if surface < 0:
                                c = (0.0, 0.0, 0.0)
                            elif edge[v, u]:
                                c = mix_surfaces(
                                    prims,
                                    faces,
                                    textures,
                                    texels,
                                    light,
                                    rays,
                                    R,
                                    o,
                                    fine,
                                    gap,
                                    n_fine,
                                    u,
                                    v,
                                    seen,
                                )
                            elif is_flat(int(prims[k, SHAPE]), face):
                                if begun != surface:
                                    begin_face(prims, R, v, o, k, face, flat)
                                    begun = surface
                                c = shade_flat(
                                    faces,
                                    textures,
                                    texels,
                                    light,
                                    surface,
                                    flat,
                                    depth[v, u],
                                    x,
                                    y,
                                    right,
                                    down,
                                )
                            else:
                                d = rotate(R, v, (x, y, 1.0))
                                a = rotate(R, v, (right[0], right[1], 0.0))
                                b = rotate(R, v, (down[0], down[1], 0.0))
                                c = shade(
                                    prims,
                                    faces,
                                    textures,
                                    texels,
                                    light,
                                    k,
                                    face,
                                    depth[v, u],
                                    o,
                                    d,
                                    a,
                                    b,
                                )
                            out[v, u, 0], out[v, u, 1], out[v, u, 2] = c
