# SPDX-License-Identifier: Apache-2.0
"""From a world to the flat arrays that the kernels read."""

import functools
import math

import cv2
import numpy as np

from edge.types import F64, I32, U8
from tools.simworld.fronts import FRONTS
from tools.simworld.kernels_light import bake
from tools.simworld.kernels_trace import FACES, LIGHT, LIGHT_ROWS, U32, Scene
from tools.simworld.materials import MATERIALS
from tools.simworld.pictures import PICTURES
from tools.simworld.world import Material, Part, Shape, Texture, World

PAINTERS = MATERIALS | PICTURES | FRONTS
GAMMA = 2.2
LIGHT_STEP_M = 0.1  # between grid points of baked light, at most
LIGHT_STEP_MIN_M = 0.05
LIGHT_CELLS = 24  # along the longer side of a face, between these bounds
OCCLUSION_REACH_M = 1.2


@functools.lru_cache(maxsize=256)
def paint(texture: Texture) -> U8:
    """The texture's image (h, w, 3) BGR; read-only."""
    rng = np.random.default_rng([texture.seed, len(texture.kind), *texture.size_px])
    image = PAINTERS[texture.kind](rng, texture.size_px, texture.colour)
    image.flags.writeable = False
    return image


def mip_levels(image: U8) -> list[U8]:
    """The image and its halves down to one texel, each (n, 3)."""
    levels = [image]
    work = image.astype(np.float32)
    while max(work.shape[:2]) > 1:
        h, w = work.shape[:2]
        half = (max(w // 2, 1), max(h // 2, 1))
        work = cv2.resize(work, half, interpolation=cv2.INTER_AREA)
        levels.append(np.clip(np.rint(work), 0, 255).astype(np.uint8))
    return levels


def face_size(part: Part, face: int) -> tuple[float, float] | None:
    """Extents of a face along its coordinates a, b [m]; None where there is no such face."""
    x, y, z = (2.0 * h for h in part.half_m)
    if part.shape is Shape.ELLIPSOID:
        return (math.pi * 0.5 * (x + y), 0.5 * math.pi * z) if face == 0 else None
    if part.shape is Shape.CYLINDER and face == 0:
        return math.pi * 0.5 * (x + y), z
    if part.shape is Shape.CYLINDER and face < 4:
        return None
    return ((y, z), (x, z), (x, y))[face // 2]


def face_signs(part: Part, face: int) -> tuple[float, float]:
    """Directions of right and down, as a viewer sees them, along a and b."""
    if part.shape in (Shape.ELLIPSOID, Shape.CYLINDER) and face == 0:
        return 1.0, -1.0
    right, down = ((-1, -1), (1, -1), (1, -1), (-1, -1), (1, 1), (1, -1))[face]
    if part.shape is Shape.ROOM:
        return (-right, down) if face < 4 else (right, -down)
    return float(right), float(down)


def face_mapping(part: Part, face: int, material: Material) -> tuple[float, ...]:
    """Six m with u = m0 a + m1 b + m2 and v = m3 a + m4 b + m5, in texels of level 0."""
    size = face_size(part, face)
    if size is None:
        return (0.0,) * 6
    h, w = material.texture.size_px
    right, down = face_signs(part, face)
    sizes, signs = (size[1], size[0]) if material.turned else size, (right, down)
    if material.turned:
        signs = (down, right)
    repeat = material.size_m or sizes
    if part.shape in (Shape.ELLIPSOID, Shape.CYLINDER) and face == 0 and material.size_m:
        around = max(1, round(size[0] / material.size_m[0]))  # no seam
        repeat = (size[0] / around, material.size_m[1])
    ku, kv = signs[0] * w / repeat[0], signs[1] * h / repeat[1]
    if material.turned:
        return (0.0, ku, 0.5 * w - 0.5, kv, 0.0, 0.5 * h - 0.5)
    return (ku, 0.0, 0.5 * w - 0.5, 0.0, kv, 0.5 * h - 0.5)


def light_grid(part: Part, face: int) -> tuple[int, int]:
    """Columns and rows of baked light on a face; 0, 0 where there is no such face."""
    size = face_size(part, face)
    if size is None:
        return 0, 0
    step = float(np.clip(max(size) / LIGHT_CELLS, LIGHT_STEP_MIN_M, LIGHT_STEP_M))
    return tuple(int(np.clip(math.ceil(s / step) + 1, 2, 400)) for s in size)  # type: ignore[return-value]


def pack_prims(world: World) -> F64:
    """The table of primitives; enough for depths and ids."""
    parts = [(thing, part) for thing in world.things for part in thing.parts]
    T = np.stack([thing.T_world_thing @ part.T_thing_part for thing, part in parts])
    half = np.array([part.half_m for _, part in parts], dtype=np.float64)
    shape = np.array([part.shape for _, part in parts])
    corner = np.linalg.norm(half, axis=1)
    radius = np.where(shape == Shape.ELLIPSOID, half.max(axis=1), corner)
    axes = T[:, :3, :3].transpose(0, 2, 1).reshape(-1, 9)
    return np.column_stack([shape, T[:, :3, 3], axes, half, radius])


def pack(world: World) -> Scene:
    """The world as tables, with its textures painted and its light baked."""
    parts = [part for thing in world.things for part in thing.parts]
    faces = [(part, f, part.faces.get(f, part.material)) for part in parts for f in range(FACES)]
    kinds = list(dict.fromkeys(m.texture for _, _, m in faces))
    where = {texture: i for i, texture in enumerate(kinds)}
    table, texels = _pack_textures(kinds)
    grids = np.array([light_grid(part, f) for part, f, _ in faces], dtype=np.int64)
    first = np.concatenate([[0], np.cumsum(grids[:, 0] * grids[:, 1])])
    mapping = np.array([face_mapping(p, f, m) for p, f, m in faces], dtype=np.float64)
    painted = np.array([where[m.texture] for _, _, m in faces])
    scene = Scene(
        prims=pack_prims(world),
        faces=np.column_stack([mapping, painted, first[:-1], grids]).astype(np.float64),
        textures=table,
        texels=texels,
        light=np.zeros((max(int(first[-1]), 1), 3), dtype=np.float32),
    )
    _light_up(world, scene, [m.glow for _, _, m in faces])
    return scene


def _pack_textures(kinds: list[Texture]) -> tuple[I32, U32]:
    table, chunks, first = [], [], 0
    for texture in kinds:
        levels = mip_levels(paint(texture))
        h, w = texture.size_px
        table.append((first, w.bit_length() - 1, h.bit_length() - 1, len(levels)))
        for level in levels:
            b, g, r = level.reshape(-1, 3).T.astype(np.uint32)
            chunks.append(b | g << 8 | r << 16)
            first += len(b)
    return np.array(table, dtype=np.int32), np.concatenate(chunks)


def _light_up(world: World, scene: Scene, glow: list[float]) -> None:
    lamps = np.array([(*m.centre_m, *m.half_m, *m.power) for m in world.lamps], dtype=np.float64)
    lamps = lamps.reshape(-1, 8)
    ticks = np.array([-0.8, 0.0, 0.8])
    spread = np.stack(np.meshgrid(ticks, ticks), axis=-1).reshape(-1, 2)
    ambient = np.array(world.ambient, dtype=np.float64)
    bake(scene, lamps, ambient, spread, _hemisphere(24), OCCLUSION_REACH_M, scene.light)
    np.power(scene.light, 1.0 / GAMMA, out=scene.light)
    for face, value in enumerate(glow):
        if value > 0.0:
            first, cols, rows = scene.faces[face, LIGHT : LIGHT_ROWS + 1].astype(int)
            scene.light[first : first + cols * rows] = value


def _hemisphere(n: int) -> F64:
    """Cosine-weighted directions (n, 3) around z, on a golden spiral."""
    k = np.arange(n) + 0.5
    radius, angle = np.sqrt(k / n), k * math.pi * (3.0 - math.sqrt(5.0))
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), np.sqrt(1 - k / n)], axis=1)
