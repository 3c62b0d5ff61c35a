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

F64: TypeAlias = NDArray[np.float64]
F32: TypeAlias = NDArray[np.float32]
I32: TypeAlias = NDArray[np.int32]
U8: TypeAlias = NDArray[np.uint8]
U32: TypeAlias = NDArray[np.uint32]
Vec3: TypeAlias = tuple[float, float, float]

BOX, ELLIPSOID, CYLINDER, ROOM = 0, 1, 2, 3
FACES = 6  # per primitive, used or not
MISS = 1e30
NEAR_M = 1e-6
ROOM_DISTANCE_M = 1e6  # sorts the room behind everything that stands in it


class Scene(NamedTuple):
    """A world as flat arrays; n primitives, f = 6 n faces."""

    shape: I32  # (n,) BOX, ELLIPSOID, CYLINDER or ROOM
    centre: F64  # (n, 3) [m]
    axes: F64  # (n, 3, 3) R_object_world
    half: F64  # (n, 3) half extents [m]
    radius: F64  # (n,) of the bounding sphere [m]
    instance: I32  # (n,)
    face_texture: I32  # (f,) index into textures
    face_uv: F64  # (f, 6) texels of level 0: u = m0 a + m1 b + m2, v = m3 a + m4 b + m5
    face_light: I32  # (f, 3) first value in `light`, grid columns, grid rows
    texture: I32  # (t, 4) first texel, log2 width, log2 height, levels
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
def rotate_back(R: F64, k: int, v: Vec3) -> Vec3:
    """R[k].T @ v for a stack of rotations (n, 3, 3)."""
    return (
        R[k, 0, 0] * v[0] + R[k, 1, 0] * v[1] + R[k, 2, 0] * v[2],
        R[k, 0, 1] * v[0] + R[k, 1, 1] * v[1] + R[k, 2, 1] * v[2],
        R[k, 0, 2] * v[0] + R[k, 1, 2] * v[1] + R[k, 2, 2] * v[2],
    )


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
def hit_primitive(scene: Scene, k: int, origin: Vec3, ray: Vec3) -> tuple[float, int]:
    """Ray parameter and face of primitive k's first hit, or MISS and -1."""
    c = scene.centre
    e = (c[k, 0] - origin[0], c[k, 1] - origin[1], c[k, 2] - origin[2])
    shape = scene.shape[k]
    if shape != ROOM:
        along = e[0] * ray[0] + e[1] * ray[1] + e[2] * ray[2]
        square = ray[0] * ray[0] + ray[1] * ray[1] + ray[2] * ray[2]
        gap = e[0] * e[0] + e[1] * e[1] + e[2] * e[2] - scene.radius[k] * scene.radius[k]
        if gap * square > along * along:
            return MISS, -1
    o = rotate(scene.axes, k, (-e[0], -e[1], -e[2]))
    d = rotate(scene.axes, k, ray)
    h = (scene.half[k, 0], scene.half[k, 1], scene.half[k, 2])
    if shape == ELLIPSOID:
        return hit_ellipsoid(o, d, h)
    if shape == CYLINDER:
        return hit_cylinder(o, d, h)
    return hit_box(o, d, h, shape == ROOM)


@inline_kernel
def trace(
    scene: Scene, order: I32, distance: F64, n: int, origin: Vec3, ray: Vec3
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
        t, face = hit_primitive(scene, order[i], origin, ray)
        if t < best:
            best, best_k, best_face = t, order[i], face
    return best, best_k, best_face


@kernel
def distance_to_bounds(scene: Scene, k: int, point: Vec3) -> float:
    """A lower bound of the distance from a point to primitive k [m]."""
    if scene.shape[k] == ROOM:
        return ROOM_DISTANCE_M
    c = scene.centre
    p = rotate(scene.axes, k, (point[0] - c[k, 0], point[1] - c[k, 1], point[2] - c[k, 2]))
    x = max(0.0, abs(p[0]) - scene.half[k, 0])
    y = max(0.0, abs(p[1]) - scene.half[k, 1])
    z = max(0.0, abs(p[2]) - scene.half[k, 2])
    return math.sqrt(x * x + y * y + z * z)


@kernel
def touches_frustum(scene: Scene, k: int, origin: Vec3, planes: F64, slack: float) -> bool:
    """Whether primitive k's box reaches inside all four planes through the origin.

    planes (4, 3) float64 are unit normals pointing inwards; `slack` [m] widens.
    """
    if scene.shape[k] == ROOM:
        return True
    c, half = scene.centre, scene.half
    e = (c[k, 0] - origin[0], c[k, 1] - origin[1], c[k, 2] - origin[2])
    for p in range(4):
        n = (planes[p, 0], planes[p, 1], planes[p, 2])
        r = rotate(scene.axes, k, n)
        reach = abs(r[0]) * half[k, 0] + abs(r[1]) * half[k, 1] + abs(r[2]) * half[k, 2]
        if e[0] * n[0] + e[1] * n[1] + e[2] * n[2] + reach + slack < 0.0:
            return False
    return True


@kernel
def cull(
    scene: Scene, given: I32, n_given: int, origin: Vec3, planes: F64, slack: float,
    order: I32, distance: F64,
) -> int:
    """Put the primitives of `given[:n_given]` that the frustum may see into `order`.

    order (n,) int32 and distance (n,) float64 are out, sorted by distance.
    Returns how many.
    """
    n = 0
    for i in range(n_given):
        k = given[i]
        if not touches_frustum(scene, k, origin, planes, slack):
            continue
        d = max(0.0, distance_to_bounds(scene, k, origin) - slack)
        j = n
        while j > 0 and distance[j - 1] > d:
            distance[j] = distance[j - 1]
            order[j] = order[j - 1]
            j -= 1
        distance[j] = d
        order[j] = k
        n += 1
    return n
