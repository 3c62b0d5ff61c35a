"""Light that does not move: soft shadows and ambient occlusion on a grid over each face."""

import math

from edge.kernel import kernel
from tools.simworld.kernels_shade import face_extent
from tools.simworld.kernels_trace import (
    CYLINDER,
    ELLIPSOID,
    F32,
    F64,
    FACES,
    ROOM,
    Scene,
    Vec3,
    hit_primitive,
    rotate_back,
)

LIFT_M = 2e-3  # start of a shadow ray above its surface
INSET = 0.02  # of a face: grid points stay off its rim, where other things touch it


@kernel
def first_block(scene: Scene, origin: Vec3, ray: Vec3, reach: float) -> float:
    """Ray parameter of some primitive that blocks the ray before `reach`, else `reach`."""
    nearest = reach
    for k in range(scene.shape.shape[0]):
        t, _ = hit_primitive(scene, k, origin, ray)
        if t > 0.0:  # a point outside the room has the wall behind it
            nearest = min(nearest, t)
    return nearest


@kernel
def is_blocked(scene: Scene, origin: Vec3, ray: Vec3) -> bool:
    """Whether anything lies between the ray's origin and its parameter 1."""
    for k in range(scene.shape.shape[0]):
        if scene.shape[k] == ROOM:
            continue
        t, _ = hit_primitive(scene, k, origin, ray)
        if t < 0.999:
            return True
    return False


@kernel
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


@kernel
def direct_light(scene: Scene, x: Vec3, n: Vec3, lamps: F64, spread: F64, i: int) -> float:
    """Lambert light of lamp i with soft shadow; lamps (m, 8) x y z size_x size_y BGR."""
    total = 0.0
    for j in range(spread.shape[0]):
        lx = lamps[i, 0] + spread[j, 0] * lamps[i, 3] - x[0]
        ly = lamps[i, 1] + spread[j, 1] * lamps[i, 4] - x[1]
        lz = lamps[i, 2] - x[2]
        square = lx * lx + ly * ly + lz * lz
        cosine = (lx * n[0] + ly * n[1] + lz * n[2]) / math.sqrt(square)
        if cosine > 0.0 and not is_blocked(scene, x, (lx, ly, lz)):
            total += cosine / (1.0 + 0.25 * square)
    return total / spread.shape[0]


@kernel
def openness(scene: Scene, x: Vec3, n: Vec3, hemisphere: F64, reach_m: float) -> float:
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
        total += math.sqrt(first_block(scene, x, d, reach_m) / reach_m)
    return total / hemisphere.shape[0]


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
    for k in range(scene.shape.shape[0]):
        h = (scene.half[k, 0], scene.half[k, 1], scene.half[k, 2])
        for face in range(FACES):
            f = k * FACES + face
            first = scene.face_light[f, 0]
            cols, rows = scene.face_light[f, 1], scene.face_light[f, 2]
            half_a, half_b = face_extent(scene.shape[k], face, h)
            if cols == 0 or half_a * half_b == 0.0:
                continue
            for row in range(rows):
                for col in range(cols):
                    s, t = 2.0 * col / (cols - 1.0) - 1.0, 2.0 * row / (rows - 1.0) - 1.0
                    p, n = grid_point(scene.shape[k], face, h, s, t)
                    if scene.shape[k] == ROOM:
                        n = (-n[0], -n[1], -n[2])
                    p = (p[0] + LIFT_M * n[0], p[1] + LIFT_M * n[1], p[2] + LIFT_M * n[2])
                    x, nw = rotate_back(scene.axes, k, p), rotate_back(scene.axes, k, n)
                    c = scene.centre
                    x = (x[0] + c[k, 0], x[1] + c[k, 1], x[2] + c[k, 2])
                    o = openness(scene, x, nw, hemisphere, reach_m)
                    i = first + row * cols + col
                    for channel in range(3):
                        out[i, channel] = ambient[channel] * o
                    for j in range(lamps.shape[0]):
                        e = direct_light(scene, x, nw, lamps, spread, j)
                        for channel in range(3):
                            out[i, channel] += lamps[j, 5 + channel] * e
