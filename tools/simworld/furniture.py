# SPDX-License-Identifier: Apache-2.0
"""Furniture: things with several parts, standing on the floor or hanging on a wall."""

import math

import numpy as np

from edge.types import F64
from tools.simworld.noise import Bgr
from tools.simworld.world import Material, Part, Shape, Texture, Vec

GREY = Material(Texture("plain", (92.0, 92.0, 94.0), 1, (64, 64)))
STEEL = Material(Texture("plain", (150.0, 150.0, 148.0), 2, (64, 64)))
BLACK = Material(Texture("plain", (38.0, 38.0, 40.0), 3, (64, 64)))
WHITE = Material(Texture("plain", (222.0, 226.0, 228.0), 4, (64, 64)))


def place(x: float, y: float, z: float, yaw: float = 0.0, tilt: float = 0.0) -> F64:
    """Transform (4, 4): turn by `tilt` around x, then by `yaw` around z, then move."""
    c, s = math.cos(yaw), math.sin(yaw)
    ct, st = math.cos(tilt), math.sin(tilt)
    return np.array(
        [[c, -s * ct, s * st, x], [s, c * ct, -c * st, y], [0.0, st, ct, z], [0.0, 0.0, 0.0, 1.0]]
    )


def box(
    size: Vec,
    at: Vec,
    material: Material,
    faces: dict[int, Material] | None = None,
    yaw: float = 0.0,
    tilt: float = 0.0,
) -> Part:
    """A box by its full size and its middle."""
    half = (0.5 * size[0], 0.5 * size[1], 0.5 * size[2])
    return Part(Shape.BOX, half, place(*at, yaw, tilt), material, faces or {})


def cylinder(
    radius: float,
    height: float,
    at: Vec,
    material: Material,
    faces: dict[int, Material] | None = None,
) -> Part:
    """An upright cylinder by radius, height and its middle."""
    return Part(Shape.CYLINDER, (radius, radius, 0.5 * height), place(*at), material, faces or {})


def ellipsoid(half: Vec, at: Vec, material: Material) -> Part:
    """An ellipsoid by its half axes and its middle."""
    return Part(Shape.ELLIPSOID, half, place(*at), material)


def surface(
    kind: str,
    colour: Bgr,
    seed: int,
    size_m: tuple[float, float] = (1.0, 1.0),
    size_px: tuple[int, int] = (512, 512),
    *,
    turned: bool = False,
) -> Material:
    """A repeating material."""
    return Material(Texture(kind, colour, seed, size_px), size_m, turned)


def picture(kind: str, colour: Bgr, seed: int, size_px: tuple[int, int] = (512, 512)) -> Material:
    """An image stretched over its face."""
    return Material(Texture(kind, colour, seed, size_px))


def table(size: Vec, top: Material, legs: Material = GREY) -> list[Part]:
    """A top of 3 cm on four legs; `size` is overall, the origin on the floor below its middle."""
    w, d, h = size
    parts = [box((w, d, 0.03), (0, 0, h - 0.015), top)]
    for sx in (-1, 1):
        for sy in (-1, 1):
            at = (sx * (0.5 * w - 0.05), sy * (0.5 * d - 0.05), 0.5 * (h - 0.03))
            parts.append(box((0.05, 0.05, h - 0.03), at, legs))
    return parts


def drawer_unit(seed: int, colour: Bgr) -> list[Part]:
    """A low cabinet under a desk, fronts towards -y."""
    wood = surface("wood", colour, seed, (0.8, 0.8))
    front = picture("drawers", colour, seed)
    return [box((0.42, 0.5, 0.6), (0, 0, 0.3), wood, {2: front})]


def office_chair(cloth: Material) -> list[Part]:
    """A seat and a leaning back on a column with a five-armed foot; faces -y."""
    parts = [
        box((0.46, 0.46, 0.07), (0, 0, 0.46), cloth),
        box((0.42, 0.05, 0.46), (0, 0.24, 0.78), cloth, tilt=-0.15),
        box((0.06, 0.03, 0.2), (0, 0.23, 0.54), BLACK),
        cylinder(0.028, 0.36, (0, 0, 0.25), STEEL),
    ]
    for i in range(5):
        a = 2 * math.pi * i / 5
        at = (0.15 * math.cos(a), 0.15 * math.sin(a), 0.06)
        parts.append(box((0.3, 0.04, 0.035), at, BLACK, yaw=a))
    return parts


def wooden_chair(wood: Material) -> list[Part]:
    """Four legs, a seat and a back of three slats; faces -y."""
    parts = [box((0.42, 0.42, 0.03), (0, 0, 0.45), wood)]
    for sx in (-0.18, 0.18):
        parts.append(box((0.04, 0.04, 0.44), (sx, -0.18, 0.22), wood))
        parts.append(box((0.04, 0.04, 0.92), (sx, 0.19, 0.46), wood))
    return parts + [box((0.34, 0.02, 0.06), (0, 0.19, z), wood) for z in (0.62, 0.74, 0.86)]


def shelf(size: Vec, boards: int, wood: Material) -> list[Part]:
    """Sides, back and boards, open towards -y, its back at y = size[1] / 2."""
    w, d, h = size
    parts = [
        box((0.025, d, h), (-0.5 * w + 0.0125, 0, 0.5 * h), wood),
        box((0.025, d, h), (0.5 * w - 0.0125, 0, 0.5 * h), wood),
        box((w - 0.05, 0.012, h), (0, 0.5 * d - 0.006, 0.5 * h), wood),
    ]
    board = (w - 0.05, d - 0.012, 0.025)
    return parts + [box(board, (0, -0.006, z), wood) for z in board_heights(size, boards)]


def board_heights(size: Vec, boards: int) -> list[float]:
    """Middles of a shelf's boards above the floor [m]."""
    return [float(z) for z in np.linspace(0.08, size[2] - 0.0125, boards)]


def cupboard(size: Vec, doors: int, wood: Material, handle: Material = STEEL) -> list[Part]:
    """A closed cabinet with doors and handles towards -y."""
    w, d, h = size
    parts = [box(size, (0, 0, 0.5 * h), wood)]
    step = w / doors
    for i in range(doors):
        x = -0.5 * w + (i + 0.5) * step
        parts.append(
            box((step - 0.012, 0.018, h - 0.1), (x, -0.5 * d - 0.009, 0.5 * h + 0.03), wood)
        )
        side = 0.5 * step - 0.06 if i % 2 == 0 else 0.06 - 0.5 * step
        at = (x + side, -0.5 * d - 0.03, 0.55 * h)
        parts.append(box((0.016, 0.024, 0.16), at, handle))
    return parts


def radiator(width: float) -> list[Part]:
    """A row of white ribs; its back is at y = 0.05."""
    ribs = round(width / 0.07)
    parts = [box((width, 0.03, 0.5), (0, 0.03, 0.4), WHITE)]
    for i in range(ribs):
        x = -0.5 * width + (i + 0.5) * width / ribs
        parts.append(box((0.035, 0.05, 0.54), (x, -0.01, 0.4), WHITE))
    return parts


def plant(seed: int, height: float) -> list[Part]:
    """A pot with a stem and a few clouds of leaves."""
    rng = np.random.default_rng([seed, 77])
    pot = surface("speckle", (90.0, 105.0, 150.0), seed, (0.5, 0.5), (256, 256))
    green = surface("leaves", (55.0, 125.0, 75.0), seed, (0.6, 0.6), (256, 256))
    parts = [cylinder(0.15, 0.3, (0, 0, 0.15), pot)]
    parts.append(cylinder(0.02, height - 0.4, (0, 0, 0.5 * (height + 0.2)), GREY))
    for _ in range(7):
        x, y = np.clip(rng.normal(0, 0.12, 2), -0.15, 0.15).tolist()
        z = rng.uniform(0.55, 1.0) * height
        half = tuple(float(v) for v in rng.uniform(0.09, 0.2, 3))
        parts.append(ellipsoid((half[0], half[1], half[2]), (x, y, z), green))
    return parts


def floor_lamp() -> list[Part]:
    """A foot, a pole and a shade."""
    return [
        cylinder(0.14, 0.03, (0, 0, 0.015), BLACK),
        cylinder(0.014, 1.5, (0, 0, 0.78), BLACK),
        cylinder(0.17, 0.26, (0, 0, 1.62), Material(WHITE.texture, None, False, 1.15)),
    ]


def bin_basket(colour: Bgr, seed: int) -> list[Part]:
    """A waste bin, dark inside."""
    skin = surface("fabric", colour, seed, (0.3, 0.3), (256, 256))
    return [cylinder(0.13, 0.32, (0, 0, 0.16), skin, {5: BLACK})]


def rug(width: float, depth: float, seed: int, colour: Bgr) -> list[Part]:
    """A flat woven rug."""
    weave = Material(Texture("stripes", colour, seed, (1024, 1024)))
    return [box((width, depth, 0.012), (0, 0, 0.006), weave)]
