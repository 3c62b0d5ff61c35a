# SPDX-License-Identifier: Apache-2.0
"""Ray against scene: intersection, and which primitives a tile of the image can see.

A primitive is a unit shape in its own axes, stretched by its half extents: a
box, an ellipsoid, an upright cylinder (its axis is its own z), or a room (a box
seen from inside). Faces are numbered 2 * axis + (1 on the positive side); an
ellipsoid has face 0 alone, a cylinder 0 (side), 4 and 5 (its ends).
"""

import math
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from edge.kernel import inline_kernel, kernel
from edge.types import F32, F64, I32

U32: TypeAlias = NDArray[np.uint32]
Vec3: TypeAlias = tuple[float, float, float]

BOX, ELLIPSOID, CYLINDER, ROOM = 0, 1, 2, 3
FACES = 6  # per primitive, used or not
MISS = 1e30
NEAR_M = 1e-6
ROOM_DISTANCE_M = 1e6  # sorts the room behind everything that stands in it


# Columns of a primitive. Everything lies in few plain tables, because each array that
# a kernel takes out of a tuple in a loop costs it two atomic reference counts.
SHAPE, CENTRE, AXES, HALF, RADIUS = 0, 1, 4, 13, 16
# Columns of a face: u = m0 a + m1 b + m2, v = m3 a + m4 b + m5 in texels of level 0;
# index of the texture; first value, columns and rows of its grid of light.
UV, TEXTURE, LIGHT, LIGHT_COLS, LIGHT_ROWS = 0, 6, 7, 8, 9


class Scene(NamedTuple):
    """A world as tables; n primitives, FACES * n faces."""

    prims: F64  # (n, 17) shape, centre [m], R_object_world, half extents [m], bounding radius [m]
    faces: F64  # (FACES * n, 10) as the columns above
    textures: I32  # (t, 4) first texel, log2 width, log2 height, levels
    texels: U32  # (m,) 0x00RRGGBB, gamma coded, all levels of all textures
    light: F32  # (l, 3) gamma-coded BGR brightness on a grid over each face


@inline_kernel
def rotate(R: F64, k: int, v: Vec3) -> Vec3:
    """R[k] @ v for a stack of rotations (n, 3, 3)."""
    return (
        R[k, 0, 0] * v[0] + R[k, 0, 1] * v[1] + R[k, 0, 2] * v[2],
        R[k, 1, 0] * v[0] + R[k, 1, 1] * v[1] + R[k, 1, 2] * v[2],
        R[k, 2, 0] * v[0] + R[k, 2, 1] * v[1] + R[k, 2, 2] * v[2],
    )


@inline_kernel
def to_local(prims: F64, k: int, v: Vec3) -> Vec3:
    """A direction of the world in primitive k's axes."""
    return (
        prims[k, AXES] * v[0] + prims[k, AXES + 1] * v[1] + prims[k, AXES + 2] * v[2],
        prims[k, AXES + 3] * v[0] + prims[k, AXES + 4] * v[1] + prims[k, AXES + 5] * v[2],
        prims[k, AXES + 6] * v[0] + prims[k, AXES + 7] * v[1] + prims[k, AXES + 8] * v[2],
    )


@inline_kernel
def to_world(prims: F64, k: int, v: Vec3) -> Vec3:
    """A direction in primitive k's axes in the world."""
    return (
        prims[k, AXES] * v[0] + prims[k, AXES + 3] * v[1] + prims[k, AXES + 6] * v[2],
        prims[k, AXES + 1] * v[0] + prims[k, AXES + 4] * v[1] + prims[k, AXES + 7] * v[2],
        prims[k, AXES + 2] * v[0] + prims[k, AXES + 5] * v[1] + prims[k, AXES + 8] * v[2],
    )


@inline_kernel
def from_centre(prims: F64, k: int, point: Vec3) -> Vec3:
    """Vector from primitive k's centre to a point, in the world's axes."""
    return (
        point[0] - prims[k, CENTRE],
        point[1] - prims[k, CENTRE + 1],
        point[2] - prims[k, CENTRE + 2],
    )


@inline_kernel
def half_extents(prims: F64, k: int) -> Vec3:
    """Half extents of primitive k [m]."""
    return prims[k, HALF], prims[k, HALF + 1], prims[k, HALF + 2]


@inline_kernel
def slab(axis: int, o: float, d: float, h: float) -> tuple[float, int, float, int]:
    """Entry and exit of one pair of parallel faces: (t, face, t, face)."""
    if abs(d) < 1e-12:  # parallel: always or never between them
        return (-MISS, -1, MISS, -1) if abs(o) <= h else (MISS, -1, -MISS, -1)
    r = 1.0 / d
    if d > 0.0:
        return (-h - o) * r, 2 * axis, (h - o) * r, 2 * axis + 1
    return (h - o) * r, 2 * axis + 1, (-h - o) * r, 2 * axis


@inline_kernel
def hit_box(o: Vec3, d: Vec3, h: Vec3, inside: bool) -> tuple[float, int]:
    """Ray parameter and face of a box's first hit, or MISS and -1.

    o, d, h are origin, direction and half extents in the box's axes; `inside`
    asks for the far side, as seen from within.
    """
    t_in, f_in, t_out, f_out = slab(0, o[0], d[0], h[0])
    t0, f0, t1, f1 = slab(1, o[1], d[1], h[1])
    if t0 > t_in:
        t_in, f_in = t0, f0
    if t1 < t_out:
        t_out, f_out = t1, f1
    t0, f0, t1, f1 = slab(2, o[2], d[2], h[2])
    if t0 > t_in:
        t_in, f_in = t0, f0
    if t1 < t_out:
        t_out, f_out = t1, f1
    if inside:
        return t_out, f_out
    if t_in > t_out or t_in < NEAR_M:
        return MISS, -1
    return t_in, f_in


@inline_kernel
def hit_ellipsoid(o: Vec3, d: Vec3, h: Vec3) -> tuple[float, int]:
    """Ray parameter and face of an ellipsoid's first hit, or MISS and -1."""
    p0, p1, p2 = o[0] / h[0], o[1] / h[1], o[2] / h[2]
    q0, q1, q2 = d[0] / h[0], d[1] / h[1], d[2] / h[2]
    a = q0 * q0 + q1 * q1 + q2 * q2
    b = p0 * q0 + p1 * q1 + p2 * q2
    c = p0 * p0 + p1 * p1 + p2 * p2 - 1.0
    disc = b * b - a * c
    if disc <= 0.0:
        return MISS, -1
    t = (-b - math.sqrt(disc)) / a
    return (t, 0) if t > NEAR_M else (MISS, -1)


@inline_kernel
def hit_cylinder(o: Vec3, d: Vec3, h: Vec3) -> tuple[float, int]:
    """Ray parameter and face of an upright elliptic cylinder's first hit."""
    p0, p1 = o[0] / h[0], o[1] / h[1]
    q0, q1 = d[0] / h[0], d[1] / h[1]
    a = q0 * q0 + q1 * q1
    if a > 1e-14:
        b = p0 * q0 + p1 * q1
        disc = b * b - a * (p0 * p0 + p1 * p1 - 1.0)
        if disc <= 0.0:
            return MISS, -1
        t = (-b - math.sqrt(disc)) / a
        if t > NEAR_M and abs(o[2] + t * d[2]) <= h[2]:
            return t, 0
    if abs(d[2]) < 1e-12:
        return MISS, -1
    face = 5 if d[2] < 0.0 else 4
    t = ((h[2] if face == 5 else -h[2]) - o[2]) / d[2]
    x, y = p0 + t * q0, p1 + t * q1
    if t > NEAR_M and x * x + y * y <= 1.0:
        return t, face
    return MISS, -1


@inline_kernel
def hit_primitive(prims: F64, k: int, origin: Vec3, ray: Vec3) -> tuple[float, int]:
    """Ray parameter and face of primitive k's first hit, or MISS and -1."""
    e = from_centre(prims, k, origin)
    shape = prims[k, SHAPE]
    if shape != ROOM:
        along = e[0] * ray[0] + e[1] * ray[1] + e[2] * ray[2]
        square = ray[0] * ray[0] + ray[1] * ray[1] + ray[2] * ray[2]
        radius = prims[k, RADIUS]
        gap = e[0] * e[0] + e[1] * e[1] + e[2] * e[2] - radius * radius
        if gap * square > along * along:
            return MISS, -1
    o, d, h = to_local(prims, k, e), to_local(prims, k, ray), half_extents(prims, k)
    if shape == ELLIPSOID:
        return hit_ellipsoid(o, d, h)
    if shape == CYLINDER:
        return hit_cylinder(o, d, h)
    return hit_box(o, d, h, shape == ROOM)


@inline_kernel
def trace(
    prims: F64, order: I32, distance: F64, n: int, origin: Vec3, ray: Vec3
) -> tuple[float, int, int]:
    """First hit among the candidates `order[:n]`, whose bounds are sorted.

    distance (n,) float64 holds lower bounds of the distance [m]. Returns the ray
    parameter, primitive and face; primitive -1 for none.
    """
    length = math.sqrt(ray[0] * ray[0] + ray[1] * ray[1] + ray[2] * ray[2])
    best, best_k, best_face = MISS, -1, -1
    for i in range(n):
        if distance[i] > best * length:
            break
        t, face = hit_primitive(prims, order[i], origin, ray)
        if t < best:
            best, best_k, best_face = t, order[i], face
    return best, best_k, best_face


@inline_kernel
def distance_to_bounds(prims: F64, k: int, point: Vec3) -> float:
    """A lower bound of the distance from a point to primitive k [m]."""
    if prims[k, SHAPE] == ROOM:
        return ROOM_DISTANCE_M
    p = to_local(prims, k, from_centre(prims, k, point))
    x = max(0.0, abs(p[0]) - prims[k, HALF])
    y = max(0.0, abs(p[1]) - prims[k, HALF + 1])
    z = max(0.0, abs(p[2]) - prims[k, HALF + 2])
    return math.sqrt(x * x + y * y + z * z)


@inline_kernel
def touches_frustum(prims: F64, k: int, origin: Vec3, planes: F64, slack: float) -> bool:
    """Whether primitive k's box reaches inside all four planes through the origin.

    planes (4, 3) float64 are unit normals pointing inwards; `slack` [m] widens.
    """
    if prims[k, SHAPE] == ROOM:
        return True
    e, h = from_centre(prims, k, origin), half_extents(prims, k)
    for p in range(4):
        n = (planes[p, 0], planes[p, 1], planes[p, 2])
        r = to_local(prims, k, n)
        reach = abs(r[0]) * h[0] + abs(r[1]) * h[1] + abs(r[2]) * h[2] + slack
        # e points from the centre to the planes' common point
        if e[0] * n[0] + e[1] * n[1] + e[2] * n[2] > reach:
            return False
    return True


@kernel
def cull(
    prims: F64,
    given: I32,
    n_given: int,
    origin: Vec3,
    planes: F64,
    slack: float,
    order: I32,
    distance: F64,
) -> int:
    """Put the primitives of `given[:n_given]` that the frustum may see into `order`.

    order (n,) int32 and distance (n,) float64 are out, sorted by distance.
    Returns how many.
    """
    n = 0
    for i in range(n_given):
        k = given[i]
        if not touches_frustum(prims, k, origin, planes, slack):
            continue
        d = max(0.0, distance_to_bounds(prims, k, origin) - slack)
        j = n
        while j > 0 and distance[j - 1] > d:
            distance[j] = distance[j - 1]
            order[j] = order[j - 1]
            j -= 1
        distance[j] = d
        order[j] = k
        n += 1
    return n
