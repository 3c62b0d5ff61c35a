"""What colour a hit has: mip-mapped texture, filtered over the pixel, times baked light."""

import math
from typing import TypeAlias

from edge.kernel import inline_kernel
from tools.simworld.kernels_trace import (
    CYLINDER,
    ELLIPSOID,
    FACES,
    Scene,
    Vec3,
    rotate,
)

Colour: TypeAlias = tuple[float, float, float]
MAX_PROBES = 6  # along the longer axis of a pixel's footprint
GRAZING = 1e-3  # cosine; below it the footprint stops growing


@inline_kernel
def sample_level(scene: Scene, first: int, log_w: int, log_h: int, u: float, v: float) -> Colour:
    """Bilinear BGR [0, 255] of one texture level at texel coordinates; wraps around."""
    x, y = math.floor(u), math.floor(v)
    a, b = u - x, v - y
    mask_u, mask_v = (1 << log_w) - 1, (1 << log_h) - 1
    x0, y0 = int(x) & mask_u, int(y) & mask_v
    x1, y1 = (x0 + 1) & mask_u, (y0 + 1) & mask_v
    i00, i01 = first + (y0 << log_w) + x0, first + (y0 << log_w) + x1
    i10, i11 = first + (y1 << log_w) + x0, first + (y1 << log_w) + x1
    w00, w01, w10, w11 = (1.0 - a) * (1.0 - b), a * (1.0 - b), (1.0 - a) * b, a * b
    t = scene.texels
    c00, c01, c10, c11 = t[i00], t[i01], t[i10], t[i11]
    return (
        w00 * (c00 & 255) + w01 * (c01 & 255) + w10 * (c10 & 255) + w11 * (c11 & 255),
        w00 * ((c00 >> 8) & 255) + w01 * ((c01 >> 8) & 255)
        + w10 * ((c10 >> 8) & 255) + w11 * ((c11 >> 8) & 255),
        w00 * (c00 >> 16) + w01 * (c01 >> 16) + w10 * (c10 >> 16) + w11 * (c11 >> 16),
    )


@inline_kernel
def sample_trilinear(scene: Scene, texture: int, u: float, v: float, lod: float) -> Colour:
    """BGR [0, 255] at level-0 texel coordinates, between two mip levels."""
    first = scene.texture[texture, 0]
    log_w, log_h = scene.texture[texture, 1], scene.texture[texture, 2]
    last = scene.texture[texture, 3] - 1
    lod = min(max(lod, 0.0), float(last))
    level = int(lod)
    part = lod - level
    for i in range(level):
        first += 1 << (max(log_w - i, 0) + max(log_h - i, 0))
    shrink = 1.0 / (1 << level)
    lw, lh = max(log_w - level, 0), max(log_h - level, 0)
    c = sample_level(scene, first, lw, lh, (u + 0.5) * shrink - 0.5, (v + 0.5) * shrink - 0.5)
    if part < 1e-3 or level >= last:
        return c
    first += 1 << (lw + lh)
    shrink *= 0.5
    lw, lh = max(lw - 1, 0), max(lh - 1, 0)
    e = sample_level(scene, first, lw, lh, (u + 0.5) * shrink - 0.5, (v + 0.5) * shrink - 0.5)
    return (
        c[0] + part * (e[0] - c[0]),
        c[1] + part * (e[1] - c[1]),
        c[2] + part * (e[2] - c[2]),
    )


@inline_kernel
def sample_footprint(
    scene: Scene, texture: int, u: float, v: float, ux: float, uy: float, vx: float, vy: float
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
        return sample_trilinear(scene, texture, u, v, math.log2(max(major, 1.0)))
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
        c = sample_trilinear(scene, texture, u + k * ex, v + k * ey, lod)
        b, g, red = b + c[0], g + c[1], red + c[2]
    return b / n, g / n, red / n


@inline_kernel
def sample_light(scene: Scene, face: int, s: float, t: float) -> Colour:
    """Gamma-coded brightness at (s, t) in [0, 1] of a face's grid."""
    first, cols, rows = scene.face_light[face, 0], scene.face_light[face, 1], scene.face_light[face, 2]
    x = min(max(s, 0.0), 1.0) * (cols - 1)
    y = min(max(t, 0.0), 1.0) * (rows - 1)
    x0, y0 = min(int(x), max(cols - 2, 0)), min(int(y), max(rows - 2, 0))
    x1, y1 = min(x0 + 1, cols - 1), min(y0 + 1, rows - 1)
    a, b = x - x0, y - y0
    i00, i01 = first + y0 * cols + x0, first + y0 * cols + x1
    i10, i11 = first + y1 * cols + x0, first + y1 * cols + x1
    w00, w01, w10, w11 = (1.0 - a) * (1.0 - b), a * (1.0 - b), (1.0 - a) * b, a * b
    light = scene.light
    return (
        w00 * light[i00, 0] + w01 * light[i01, 0] + w10 * light[i10, 0] + w11 * light[i11, 0],
        w00 * light[i00, 1] + w01 * light[i01, 1] + w10 * light[i10, 1] + w11 * light[i11, 1],
        w00 * light[i00, 2] + w01 * light[i01, 2] + w10 * light[i10, 2] + w11 * light[i11, 2],
    )


@inline_kernel
def surface(shape: int, face: int, p: Vec3, h: Vec3) -> tuple[float, float, Vec3, Vec3, Vec3]:
    """Face coordinates a, b [m], their directions, and the normal at a local point.

    A box's face has the two other axes in order. The side of a cylinder and the
    ellipsoid have arc length around z (at the mean radius) and height or arc
    length from the equator.
    """
    if shape == ELLIPSOID:
        n = (p[0] / (h[0] * h[0]), p[1] / (h[1] * h[1]), p[2] / (h[2] * h[2]))
        s = 1.0 / math.sqrt(n[0] * n[0] + n[1] * n[1] + n[2] * n[2])
        n = (n[0] * s, n[1] * s, n[2] * s)
        r = 0.5 * (h[0] + h[1])
        flat = max(math.sqrt(n[0] * n[0] + n[1] * n[1]), 0.02)
        along = (-n[1] / flat, n[0] / flat, 0.0)
        up = (-n[2] * along[1], n[2] * along[0], n[0] * along[1] - n[1] * along[0])
        z = min(max(p[2] / h[2], -1.0), 1.0)
        return math.atan2(p[1] / h[1], p[0] / h[0]) * r, math.asin(z) * h[2], along, up, n
    if shape == CYLINDER and face == 0:
        nx, ny = p[0] / (h[0] * h[0]), p[1] / (h[1] * h[1])
        s = 1.0 / math.sqrt(nx * nx + ny * ny)
        n = (nx * s, ny * s, 0.0)
        r = 0.5 * (h[0] + h[1])
        angle = math.atan2(p[1] / h[1], p[0] / h[0])
        return angle * r, p[2], (-n[1], n[0], 0.0), (0.0, 0.0, 1.0), n
    axis = face // 2
    sign = 1.0 if face % 2 == 1 else -1.0
    if axis == 0:
        return p[1], p[2], (0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (sign, 0.0, 0.0)
    if axis == 1:
        return p[0], p[2], (1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, sign, 0.0)
    return p[0], p[1], (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, sign)


@inline_kernel
def face_extent(shape: int, face: int, h: Vec3) -> tuple[float, float]:
    """Half sizes of a face in its coordinates a, b [m]."""
    if shape == ELLIPSOID:
        return math.pi * 0.5 * (h[0] + h[1]), 0.5 * math.pi * h[2]
    if shape == CYLINDER and face == 0:
        return math.pi * 0.5 * (h[0] + h[1]), h[2]
    if face < 2:
        return h[1], h[2]
    if face < 4:
        return h[0], h[2]
    return h[0], h[1]


@inline_kernel
def dot(a: Vec3, b: Vec3) -> float:
    """Scalar product."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@inline_kernel
def slide(d: Vec3, step: Vec3, n: Vec3, scale: float) -> Vec3:
    """How far the hit moves on its tangent plane when the ray turns by `step`.

    `scale` is the ray parameter over the cosine n.d.
    """
    facing = dot(n, d)
    turn = dot(n, step)
    return (
        scale * (facing * step[0] - turn * d[0]),
        scale * (facing * step[1] - turn * d[1]),
        scale * (facing * step[2] - turn * d[2]),
    )


@inline_kernel
def shade(
    scene: Scene, k: int, face: int, t: float, origin: Vec3, ray: Vec3, right: Vec3, down: Vec3
) -> Colour:
    """BGR [0, 255], unclipped, of a hit on primitive k.

    `right` and `down` are the changes of the ray to the next pixels.
    """
    c = scene.centre
    d = rotate(scene.axes, k, ray)
    o = rotate(
        scene.axes, k, (origin[0] - c[k, 0], origin[1] - c[k, 1], origin[2] - c[k, 2])
    )
    p = (o[0] + t * d[0], o[1] + t * d[1], o[2] + t * d[2])
    h = (scene.half[k, 0], scene.half[k, 1], scene.half[k, 2])
    shape = scene.shape[k]
    a, b, ea, eb, n = surface(shape, face, p, h)
    half_a, half_b = face_extent(shape, face, h)
    f = k * FACES + face
    light = sample_light(scene, f, 0.5 * (a / half_a + 1.0), 0.5 * (b / half_b + 1.0))

    facing = dot(n, d)
    if abs(facing) < GRAZING:
        facing = math.copysign(GRAZING, facing)
    px = slide(d, rotate(scene.axes, k, right), n, t / facing)
    py = slide(d, rotate(scene.axes, k, down), n, t / facing)
    ax, ay = dot(px, ea), dot(py, ea)
    bx, by = dot(px, eb), dot(py, eb)
    m = scene.face_uv
    u = m[f, 0] * a + m[f, 1] * b + m[f, 2]
    v = m[f, 3] * a + m[f, 4] * b + m[f, 5]
    colour = sample_footprint(
        scene, scene.face_texture[f], u, v,
        m[f, 0] * ax + m[f, 1] * bx, m[f, 0] * ay + m[f, 1] * by,
        m[f, 3] * ax + m[f, 4] * bx, m[f, 3] * ay + m[f, 4] * by,
    )
    return colour[0] * light[0], colour[1] * light[1], colour[2] * light[2]
