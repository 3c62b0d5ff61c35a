# SPDX-License-Identifier: Apache-2.0
"""A corridor for forward motion."""

from tools.simworld import furniture as make
from tools.simworld.builder import GAP_M, Builder
from tools.simworld.furniture import place
from tools.simworld.look import Look
from tools.simworld.world import World

EAST, WEST = 2, 3
NORTH, SOUTH = 0, 1
LENGTH_M, WIDTH_M, HEIGHT_M = 24.0, 2.6, 2.6


def corridor(seed: int, look: Look) -> World:
    """24 m along y: doors, posters and boards on both sides, cupboards, pipes, lamps."""
    b = Builder((WIDTH_M, LENGTH_M, HEIGHT_M), seed, look)
    b.shell(look.walls(), look.floor(), look.ceiling())
    for y in range(-10, 11, 4):
        b.ceiling_lamp(0.0, float(y), 0.42)
    pipes = [
        make.box((0.07, LENGTH_M, 0.07), (x, 0, HEIGHT_M - 0.12), make.STEEL) for x in (-1.1, -0.98)
    ]
    b.add("pipes", pipes, place(0, 0, 0))
    for wall in (EAST, WEST):
        _side(b, wall)
    for wall in (NORTH, SOUTH):
        b.door(wall, 0.0)
        b.hang("poster", wall, 0.85, 1.6, (0.5, 0.7), look.poster())
        b.hang("poster", wall, -0.85, 1.6, (0.5, 0.7), look.poster())
    return b.world("corridor", seed)


def _side(b: Builder, wall: int) -> None:
    """What stands and hangs along one long wall, one thing after the other."""
    at = -0.5 * LENGTH_M + 0.8
    kinds = ("door", "poster", "notes", "cupboard", "poster", "picture", "plant", "poster")
    while at < 0.5 * LENGTH_M - 1.2:
        kind = kinds[b.rng.integers(len(kinds))]
        if kind == "door":
            b.door(wall, at + 0.55)
            at += 1.2
        elif kind == "notes":
            image = b.look.image("notes", (1024, 1024))
            b.hang("notes", wall, at + 0.65, 1.5, (1.2, 0.9), image)
            at += 1.4
        elif kind == "cupboard":
            T = b.wall_place(wall, at + 0.5, 0.16 + GAP_M)
            base = b.add("cupboard", make.cupboard((0.9, 0.3, 0.9), 2, b.look.wood()), T)
            for x, what in ((-0.25, "carton"), (0.05, "figurine"), (0.3, "ball")):
                b.put(what, base, T, x, 0.0, 0.9, float(b.rng.uniform(-1, 1)))
            b.hang("poster", wall, at + 0.5, 1.65, (0.6, 0.75), b.look.poster())
            at += 1.1
        elif kind == "plant":
            b.add("plant", make.plant(b.look.seed(), 1.2), b.wall_place(wall, at + 0.35, 0.36))
            at += 0.8
        else:
            w = float(b.rng.uniform(0.45, 0.75))
            z = float(b.rng.uniform(1.4, 1.7))
            b.hang(kind, wall, at + 0.5 * w, z, (w, w * float(b.rng.uniform(0.8, 1.4))),
                   b.look.poster())  # fmt: skip
            at += w + float(b.rng.uniform(0.1, 0.35))
