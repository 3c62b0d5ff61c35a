# SPDX-License-Identifier: Apache-2.0
"""Light that does not move: soft shadows and ambient occlusion on a grid over each face."""

import math

import numpy as np

from edge.kernel import inline_kernel, kernel
from edge.types import F32, F64, I32
from tools.simworld.kernels_trace import (
    CENTRE,
    CYLINDER,
    ELLIPSOID,
    FACES,
    LIGHT,
    LIGHT_COLS,
    LIGHT_ROWS,
    RADIUS,
    ROOM,
    SHAPE,
    Scene,
    Vec3,
    distance_to_bounds,
    from_centre,
    half_extents,
    hit_primitive,
    to_world,
)

PATCH = 8  # grid points a side that share their lists of shading things
FALLOFF_M2 = 0.25  # a lamp's light halves at 2 m
LIFT_M = 2e-3  # start of a shadow ray above its surface
INSET = 0.02  # of a face: grid points stay off its rim, where other things touch it


@inline_kernel
def first_block(prims: F64, near: I32, n: int, origin: Vec3, ray: Vec3, reach: float) -> float:
    """Ray parameter at which one of near[:n] blocks the ray before `reach`, else `reach`."""
    nearest = reach
    for i in range(n):
        t, _ = hit_primitive(prims, near[i], origin, ray)
        if t > 0.0:  # a point outside the room has the wall behind it
            nearest = min(nearest, t)
    return nearest


@inline_kernel
def is_blocked(prims: F64, between: I32, n: int, origin: Vec3, ray: Vec3) -> bool:
    """Whether one of between[:n] lies between the ray's origin and its parameter 1."""
    for i in range(n):
        t, _ = hit_primitive(prims, between[i], origin, ray)
        if t < 0.999:
            return True
    return False


@kernel
def find_near(prims: F64, x: Vec3, reach: float, near: I32) -> int:
    """Put the primitives within `reach` [m] of x into near (n,) int32; returns how many."""
    n = 0
    for k in range(prims.shape[0]):
        if prims[k, SHAPE] == ROOM or distance_to_bounds(prims, k, x) < reach:
            near[n] = k
            n += 1
    return n


@kernel
def find_between(prims: F64, x: Vec3, radius: float, lamp: Vec3, between: I32) -> int:
    """Put what a tube of `radius` [m] from x to a lamp may touch into between (n,) int32."""
    d = (lamp[0] - x[0], lamp[1] - x[1], lamp[2] - x[2])
    square = d[0] * d[0] + d[1] * d[1] + d[2] * d[2] + 1e-12
    n = 0
    for k in range(prims.shape[0]):
        e = from_centre(prims, k, x)
        t = min(max(-(e[0] * d[0] + e[1] * d[1] + e[2] * d[2]) / square, 0.0), 1.0)
        y = (e[0] + t * d[0], e[1] + t * d[1], e[2] + t * d[2])
        reach = prims[k, RADIUS] + radius
        if prims[k, SHAPE] != ROOM and y[0] * y[0] + y[1] * y[1] + y[2] * y[2] < reach * reach:
            between[n] = k
            n += 1
    return n


@inline_kernel
def grid_point(shape: int, face: int, h: Vec3, s: float, t: float) -> tuple[Vec3, Vec3]:
    """Local point and outward normal at grid place (s, t) in [-1, 1] of a face."""
    s, t = s * (1.0 - INSET), t * (1.0 - INSET)
    if shape == ELLIPSOID:
        lon, lat = s * math.pi, t * 0.5 * math.pi
        c = math.cos(lat)
        p = (h[0] * c * math.cos(lon), h[1] * c * math.sin(lon), h[2] * math.sin(lat))
        n = (p[0] / (h[0] * h[0]), p[1] / (h[1] * h[1]), p[2] / (h[2] * h[2]))
        q = 1.0 / math.sqrt(n[0] * n[0] + n[1] * n[1] + n[2] * n[2])
        return p, (n[0] * q, n[1] * q, n[2] * q)
    if shape == CYLINDER and face == 0:
        c, d = math.cos(s * math.pi), math.sin(s * math.pi)
        q = 1.0 / math.sqrt((c / h[0]) ** 2 + (d / h[1]) ** 2)
        return (h[0] * c, h[1] * d, t * h[2]), (c / h[0] * q, d / h[1] * q, 0.0)
    sign = 1.0 if face % 2 == 1 else -1.0
    if face < 2:
        return (sign * h[0], s * h[1], t * h[2]), (sign, 0.0, 0.0)
    if face < 4:
        return (s * h[0], sign * h[1], t * h[2]), (0.0, sign, 0.0)
    return (s * h[0], t * h[1], sign * h[2]), (0.0, 0.0, sign)


@inline_kernel
def direct_light(
    prims: F64, between: I32, n: int, x: Vec3, normal: Vec3, lamps: F64, spread: F64, i: int
) -> float:
    """Lambert light of lamp i with soft shadow; lamps (m, 8) as `bake` takes them."""
    total = 0.0
    for j in range(spread.shape[0]):
        lx = lamps[i, 0] + spread[j, 0] * lamps[i, 3] - x[0]
        ly = lamps[i, 1] + spread[j, 1] * lamps[i, 4] - x[1]
        lz = lamps[i, 2] - x[2]
        square = lx * lx + ly * ly + lz * lz
        cosine = (lx * normal[0] + ly * normal[1] + lz * normal[2]) / math.sqrt(square)
        if cosine > 0.0 and not is_blocked(prims, between, n, x, (lx, ly, lz)):
            total += cosine / (1.0 + FALLOFF_M2 * square)
    return float(total / spread.shape[0])


@inline_kernel
def openness(
    prims: F64, near: I32, count: int, x: Vec3, n: Vec3, hemisphere: F64, reach_m: float
) -> float:
    """1 where nothing is near, down to 0 in a closed corner; cosine weighted."""
    # a basis around n: whichever axis is not nearly parallel to it
    a = (0.0, 0.0, 1.0) if abs(n[2]) < 0.9 else (1.0, 0.0, 0.0)
    b = (n[1] * a[2] - n[2] * a[1], n[2] * a[0] - n[0] * a[2], n[0] * a[1] - n[1] * a[0])
    q = 1.0 / math.sqrt(b[0] * b[0] + b[1] * b[1] + b[2] * b[2])
    b = (b[0] * q, b[1] * q, b[2] * q)
    c = (n[1] * b[2] - n[2] * b[1], n[2] * b[0] - n[0] * b[2], n[0] * b[1] - n[1] * b[0])
    total = 0.0
    for j in range(hemisphere.shape[0]):
        e = (hemisphere[j, 0], hemisphere[j, 1], hemisphere[j, 2])
        d = (
            e[0] * b[0] + e[1] * c[0] + e[2] * n[0],
            e[0] * b[1] + e[1] * c[1] + e[2] * n[1],
            e[0] * b[2] + e[1] * c[2] + e[2] * n[2],
        )
        total += math.sqrt(first_block(prims, near, count, x, d, reach_m) / reach_m)
    return float(total / hemisphere.shape[0])


@inline_kernel
def lit_point(
    prims: F64, k: int, face: int, cols: int, rows: int, col: float, row: float
) -> tuple[Vec3, Vec3]:
    """Place and normal in the world of a grid point, just above its face."""
    s, t = 2.0 * col / (cols - 1.0) - 1.0, 2.0 * row / (rows - 1.0) - 1.0
    p, n = grid_point(int(prims[k, SHAPE]), face, half_extents(prims, k), s, t)
    if prims[k, SHAPE] == ROOM:
        n = (-n[0], -n[1], -n[2])
    p = (p[0] + LIFT_M * n[0], p[1] + LIFT_M * n[1], p[2] + LIFT_M * n[2])
    x = to_world(prims, k, p)
    c = (prims[k, CENTRE], prims[k, CENTRE + 1], prims[k, CENTRE + 2])
    return (x[0] + c[0], x[1] + c[1], x[2] + c[2]), to_world(prims, k, n)


@kernel
def light_patch(
    prims: F64,
    lamps: F64,
    ambient: F64,
    spread: F64,
    hemisphere: F64,
    reach_m: float,
    k: int,
    face: int,
    cols: int,
    rows: int,
    col0: int,
    row0: int,
    first: int,
    near: I32,
    between: I32,
    out: F32,
) -> None:
    """Light of PATCH x PATCH grid points, against only what may shade them."""
    col1, row1 = min(col0 + PATCH, cols), min(row0 + PATCH, rows)
    middle, _ = lit_point(
        prims, k, face, cols, rows, 0.5 * (col0 + col1 - 1), 0.5 * (row0 + row1 - 1)
    )
    radius = 0.0
    for row in range(row0, row1):
        for col in range(col0, col1):
            x, _ = lit_point(prims, k, face, cols, rows, float(col), float(row))
            gap = (x[0] - middle[0]) ** 2 + (x[1] - middle[1]) ** 2 + (x[2] - middle[2]) ** 2
            radius = max(radius, math.sqrt(gap))
    count = find_near(prims, middle, reach_m + radius, near)
    for row in range(row0, row1):
        for col in range(col0, col1):
            x, n = lit_point(prims, k, face, cols, rows, float(col), float(row))
            o = openness(prims, near, count, x, n, hemisphere, reach_m)
            for channel in range(3):
                out[first + row * cols + col, channel] = ambient[channel] * o
    for j in range(lamps.shape[0]):
        lamp = (lamps[j, 0], lamps[j, 1], lamps[j, 2])
        width = max(radius, math.sqrt(lamps[j, 3] ** 2 + lamps[j, 4] ** 2))
        count = find_between(prims, middle, width, lamp, between)
        for row in range(row0, row1):
            for col in range(col0, col1):
                x, n = lit_point(prims, k, face, cols, rows, float(col), float(row))
                e = direct_light(prims, between, count, x, n, lamps, spread, j)
                for channel in range(3):
                    out[first + row * cols + col, channel] += lamps[j, 5 + channel] * e


@kernel
def bake(
    scene: Scene, lamps: F64, ambient: F64, spread: F64, hemisphere: F64, reach_m: float, out: F32
) -> None:
    """Linear BGR light on every grid point of every face.

    lamps      (m, 8)  float64  place x y z, half sizes x y [m], power B G R
    ambient    (3,)    float64  B G R
    spread     (s, 2)  float64  places on a lamp in [-1, 1]
    hemisphere (r, 3)  float64  unit directions around z, cosine weighted
    out        (l, 3)  float32  as `Scene.light`, but linear
    """
    prims, faces = scene.prims, scene.faces
    near, between = np.empty(prims.shape[0], np.int32), np.empty(prims.shape[0], np.int32)
    for f in range(faces.shape[0]):
        cols, rows = int(faces[f, LIGHT_COLS]), int(faces[f, LIGHT_ROWS])
        for row in range(0, rows, PATCH):
            for col in range(0, cols, PATCH):
                light_patch(
                    prims,
                    lamps,
                    ambient,
                    spread,
                    hemisphere,
                    reach_m,
                    f // FACES,
                    f % FACES,
                    cols,
                    rows,
                    col,
                    row,
                    int(faces[f, LIGHT]),
                    near,
                    between,
                    out,
                )
