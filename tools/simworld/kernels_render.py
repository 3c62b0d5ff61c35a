"""A whole image: tiles with short candidate lists, then colours with smooth edges."""

import math

import numpy as np

from edge.kernel import inline_kernel, kernel
from edge.types import F32, F64, I32, U8
from tools.simworld.kernels_shade import begin_face, is_flat, shade, shade_flat
from tools.simworld.kernels_texture import Colour
from tools.simworld.kernels_trace import (
    FACES,
    MISS,
    SHAPE,
    U32,
    Scene,
    Vec3,
    cull,
    hit_primitive,
    rotate,
    trace,
)

TILE = 16  # [px]
BLOCK = 64  # [px]; candidates are narrowed down block, then tile
MARGIN_PX = 2.0  # the edges of a tile bend with distortion and moving rows
SAMPLES = 8
# one sample in each of eight rows and columns, so that an upright edge has eight steps
SAMPLE_U = np.array([1, -1, 5, -3, -5, -7, 3, 7], dtype=np.float64) / 16.0
SAMPLE_V = np.array([-3, 3, 1, -5, 5, -1, 7, -7], dtype=np.float64) / 16.0


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


@kernel
def frustum(
    rays: F64, R: F64, p: F64, u0: int, v0: int, u1: int, v1: int, corners: F64, planes: F64
) -> float:
    """Planes (4, 3) around the rays of pixels [u0, u1) x [v0, v1), from row v0's origin.

    corners (4, 3) and planes are out. Returns the slack [m] for the rows' motion.
    """
    top, bottom = v0, v1 - 1
    for i in range(4):
        u = u0 - MARGIN_PX if i in (0, 3) else u1 - 1 + MARGIN_PX
        v = v0 - MARGIN_PX if i < 2 else v1 - 1 + MARGIN_PX
        c = world_ray(rays, R, top if i < 2 else bottom, u, v)
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
    dx, dy, dz = p[bottom, 0] - p[top, 0], p[bottom, 1] - p[top, 1], p[bottom, 2] - p[top, 2]
    return 1e-4 + math.sqrt(dx * dx + dy * dy + dz * dz)


@kernel
def trace_image(prims: F64, rays: F64, R: F64, p: F64, key: I32, depth: F64) -> None:
    """Surface and depth at every pixel's centre.

    prims (n, 17)  float64  as in `Scene`
    rays  (h + 1, w + 1, 2)  float64  camera rays x, y at z = 1 on whole pixels, or nan
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
                            t, k, face = trace(prims, fine, gap, n_fine, o, d)
                            key[v, u] = k * FACES + face if k >= 0 else -1
                            depth[v, u] = t if k >= 0 else 0.0


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


@inline_kernel
def neighbours(key: I32, v: int, u: int, found: I32) -> int:
    """Put the distinct primitives seen in the 3 x 3 pixels around (v, u) into found (9,)."""
    n = 0
    for i in range(max(v - 1, 0), min(v + 2, key.shape[0])):
        for j in range(max(u - 1, 0), min(u + 2, key.shape[1])):
            k = key[i, j] // FACES
            new = k >= 0
            for m in range(n):
                new = new and found[m] != k
            if new:
                found[n] = k
                n += 1
    return n


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
    n: int,
    u: int,
    v: int,
    seen: F64,
) -> Colour:
    """Colour of a pixel that the primitives order[:n] share, each face shaded once.

    seen (SAMPLES, 6) float64 is scratch: key, count, sums of u and v, first u and v.
    """
    groups = 0
    for s in range(SAMPLES):
        us, vs = u + SAMPLE_U[s], v + SAMPLE_V[s]
        d = world_ray(rays, R, v, us, vs)
        best, key = MISS, -1
        for i in range(n):
            t, face = hit_primitive(prims, order[i], origin, d)
            if t < best:
                best, key = t, FACES * order[i] + face
        if key < 0:
            continue
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
    order = np.empty(9, np.int32)
    seen = np.empty((SAMPLES, 6))
    flat = np.empty(14)
    for v in range(h):
        o = (p[v, 0], p[v, 1], p[v, 2])
        begun = -1
        for u in range(w):
            surface = key[v, u]
            k, face = surface // FACES, surface % FACES
            x, y = rays[v, u, 0], rays[v, u, 1]
            right = (rays[v, u + 1, 0] - x, rays[v, u + 1, 1] - y)
            down = (rays[v + 1, u, 0] - x, rays[v + 1, u, 1] - y)
            if edge[v, u]:
                n = neighbours(key, v, u, order)
                c = mix_surfaces(
                    prims, faces, textures, texels, light, rays, R, o, order, n, u, v, seen
                )
            elif surface < 0:
                c = (0.0, 0.0, 0.0)
            elif is_flat(int(prims[k, SHAPE]), face):
                if begun != surface:
                    begin_face(prims, R, v, o, k, face, flat)
                    begun = surface
                c = shade_flat(
                    faces, textures, texels, light, surface, flat, depth[v, u], x, y, right, down
                )
            else:
                d = rotate(R, v, (x, y, 1.0))
                r = rotate(R, v, (right[0], right[1], 0.0))
                b = rotate(R, v, (down[0], down[1], 0.0))
                c = shade(prims, faces, textures, texels, light, k, face, depth[v, u], o, d, r, b)
            out[v, u, 0], out[v, u, 1], out[v, u, 2] = c
