# SPDX-License-Identifier: Apache-2.0
"""What colour a hit has: its texture, filtered over the pixel, times baked light."""

import math
from typing import TypeAlias

from edge.kernel import inline_kernel
from edge.types import F32, F64, I32
from tools.simworld.kernels_texture import Colour, sample_footprint
from tools.simworld.kernels_trace import (
    BOX,
    CYLINDER,
    ELLIPSOID,
    FACES,
    LIGHT,
    LIGHT_COLS,
    LIGHT_ROWS,
    ROOM,
    SHAPE,
    TEXTURE,
    U32,
    UV,
    Vec3,
    from_centre,
    half_extents,
    to_local,
)

Vec2: TypeAlias = tuple[float, float]
GRAZING = 1e-3  # cosine; below it the footprint stops growing


@inline_kernel
def sample_light(faces: F64, light: F32, face: int, s: float, t: float) -> Colour:
    """Gamma-coded brightness at (s, t) in [0, 1] of a face's grid."""
    first = int(faces[face, LIGHT])
    cols, rows = int(faces[face, LIGHT_COLS]), int(faces[face, LIGHT_ROWS])
    x = min(max(s, 0.0), 1.0) * (cols - 1)
    y = min(max(t, 0.0), 1.0) * (rows - 1)
    x0, y0 = min(int(x), max(cols - 2, 0)), min(int(y), max(rows - 2, 0))
    x1, y1 = min(x0 + 1, cols - 1), min(y0 + 1, rows - 1)
    a, b = x - x0, y - y0
    i00, i01 = first + y0 * cols + x0, first + y0 * cols + x1
    i10, i11 = first + y1 * cols + x0, first + y1 * cols + x1
    w00, w01, w10, w11 = (1.0 - a) * (1.0 - b), a * (1.0 - b), (1.0 - a) * b, a * b
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
def is_flat(shape: int, face: int) -> bool:
    """Whether that face is a plane."""
    return shape in (BOX, ROOM) or (shape == CYLINDER and face != 0)


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
    prims: F64,
    faces: F64,
    textures: I32,
    texels: U32,
    light: F32,
    k: int,
    face: int,
    t: float,
    origin: Vec3,
    ray: Vec3,
    right: Vec3,
    down: Vec3,
) -> Colour:
    """BGR [0, 255], unclipped, of a hit on primitive k.

    `right` and `down` are the changes of the ray to the next pixels.
    """
    d = to_local(prims, k, ray)
    o = to_local(prims, k, from_centre(prims, k, origin))
    p = (o[0] + t * d[0], o[1] + t * d[1], o[2] + t * d[2])
    h = half_extents(prims, k)
    shape = int(prims[k, SHAPE])
    a, b, ea, eb, n = surface(shape, face, p, h)
    half_a, half_b = face_extent(shape, face, h)
    f = k * FACES + face
    g = sample_light(faces, light, f, 0.5 * (a / half_a + 1.0), 0.5 * (b / half_b + 1.0))

    facing = dot(n, d)
    if abs(facing) < GRAZING:
        facing = math.copysign(GRAZING, facing)
    px = slide(d, to_local(prims, k, right), n, t / facing)
    py = slide(d, to_local(prims, k, down), n, t / facing)
    ax, ay = dot(px, ea), dot(py, ea)
    bx, by = dot(px, eb), dot(py, eb)
    u = faces[f, UV + 0] * a + faces[f, UV + 1] * b + faces[f, UV + 2]
    v = faces[f, UV + 3] * a + faces[f, UV + 4] * b + faces[f, UV + 5]
    colour = sample_footprint(
        textures,
        texels,
        int(faces[f, TEXTURE]),
        u,
        v,
        faces[f, UV + 0] * ax + faces[f, UV + 1] * bx,
        faces[f, UV + 0] * ay + faces[f, UV + 1] * by,
        faces[f, UV + 3] * ax + faces[f, UV + 4] * bx,
        faces[f, UV + 3] * ay + faces[f, UV + 4] * by,
    )
    return colour[0] * g[0], colour[1] * g[1], colour[2] * g[2]


@inline_kernel
def begin_face(prims: F64, R: F64, row: int, origin: Vec3, k: int, face: int, f: F64) -> None:
    """Put what all pixels of a row share on one flat face into f (17,).

    In the camera's axes: 0-2 the face's normal, 3 its distance along it, 4-6 and
    8-10 its directions a, b with the origin's place on them in 7 and 11; 12, 13 half sizes.
    """
    o = to_local(prims, k, from_centre(prims, k, origin))
    x = to_local(prims, k, (R[row, 0, 0], R[row, 1, 0], R[row, 2, 0]))
    y = to_local(prims, k, (R[row, 0, 1], R[row, 1, 1], R[row, 2, 1]))
    z = to_local(prims, k, (R[row, 0, 2], R[row, 1, 2], R[row, 2, 2]))
    h = half_extents(prims, k)
    sign = 1.0 if face % 2 == 1 else -1.0
    if face < 2:
        n, a, b = (x[0], y[0], z[0]), (x[1], y[1], z[1]), (x[2], y[2], z[2])
        f[3], f[7], f[11] = sign * h[0] - o[0], o[1], o[2]
    elif face < 4:
        n, a, b = (x[1], y[1], z[1]), (x[0], y[0], z[0]), (x[2], y[2], z[2])
        f[3], f[7], f[11] = sign * h[1] - o[1], o[0], o[2]
    else:
        n, a, b = (x[2], y[2], z[2]), (x[0], y[0], z[0]), (x[1], y[1], z[1])
        f[3], f[7], f[11] = sign * h[2] - o[2], o[0], o[1]
    f[0], f[1], f[2] = n
    f[4], f[5], f[6] = a
    f[8], f[9], f[10] = b
    f[12], f[13] = face_extent(int(prims[k, SHAPE]), face, h)


@inline_kernel
def slide_flat(f: F64, at: int, along: float, t: float, stretch: float, step: Vec2) -> float:
    """How far the hit moves along f[at : at + 2] when the camera ray turns by `step`."""
    turn = f[0] * step[0] + f[1] * step[1]
    return float(t * (f[at] * step[0] + f[at + 1] * step[1] - along * turn * stretch))


@inline_kernel
def shade_flat(
    faces: F64,
    textures: I32,
    texels: U32,
    light: F32,
    surface: int,
    f: F64,
    t: float,
    x: float,
    y: float,
    right: Vec2,
    down: Vec2,
) -> Colour:
    """As `shade`, for the camera ray (x, y, 1) on the face that `begin_face` began.

    `surface` is FACES * primitive + face; `right` and `down` are in the camera's axes.
    """
    along_a = f[4] * x + f[5] * y + f[6]
    along_b = f[8] * x + f[9] * y + f[10]
    a, b = f[7] + t * along_a, f[11] + t * along_b
    g = sample_light(faces, light, surface, 0.5 * (a / f[12] + 1.0), 0.5 * (b / f[13] + 1.0))
    # one over the ray's part along the normal
    stretch = min(max(t / f[3], -1.0 / GRAZING), 1.0 / GRAZING)
    ax, ay = (
        slide_flat(f, 4, along_a, t, stretch, right),
        slide_flat(f, 4, along_a, t, stretch, down),
    )
    bx, by = (
        slide_flat(f, 8, along_b, t, stretch, right),
        slide_flat(f, 8, along_b, t, stretch, down),
    )
    colour = sample_footprint(
        textures,
        texels,
        int(faces[surface, TEXTURE]),
        faces[surface, UV + 0] * a + faces[surface, UV + 1] * b + faces[surface, UV + 2],
        faces[surface, UV + 3] * a + faces[surface, UV + 4] * b + faces[surface, UV + 5],
        faces[surface, UV + 0] * ax + faces[surface, UV + 1] * bx,
        faces[surface, UV + 0] * ay + faces[surface, UV + 1] * by,
        faces[surface, UV + 3] * ax + faces[surface, UV + 4] * bx,
        faces[surface, UV + 3] * ay + faces[surface, UV + 4] * by,
    )
    return colour[0] * g[0], colour[1] * g[1], colour[2] * g[2]
