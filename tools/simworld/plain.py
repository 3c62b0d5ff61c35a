# SPDX-License-Identifier: Apache-2.0
"""A room of painted walls and few edges, where hardly a corner is to be seen."""

from tools.simworld import furniture as make
from tools.simworld.builder import GAP_M, Builder
from tools.simworld.furniture import place
from tools.simworld.look import Look
from tools.simworld.noise import Bgr
from tools.simworld.world import Material, Texture, World

HEIGHT_M = 2.6
AMBIENT = 0.55  # most of the light: shadows are weak


def plain_room(seed: int, look: Look) -> World:
    """Four pale walls, a door, a window, a cupboard, a table and a board; all of it one paint."""
    b = Builder((0.0, 0.0, HEIGHT_M), seed, look)
    b.size = (float(b.rng.uniform(5.2, 6.8)), float(b.rng.uniform(4.4, 5.6)), HEIGHT_M)
    grey = float(b.rng.uniform(185.0, 215.0))
    walls = [_paint(grey + float(step)) for step in b.rng.permutation([-9.0, -3.0, 3.0, 9.0])]
    b.shell(walls, _paint(grey - 60.0), _paint(grey + 18.0))
    b.ceiling_lamp(0.0, 0.0, 0.35)
    order = [int(wall) for wall in b.rng.permutation(4)]
    half = [0.5 * b.length(wall) for wall in order]
    b.door(order[0], float(b.rng.uniform(-0.5, 0.5)) * half[0])
    b.window(order[1], float(b.rng.uniform(-0.4, 0.4)) * half[1], 1.4, 0.2)
    cupboard = make.cupboard((1.2, 0.45, 1.1), 2, _paint(grey - 35.0))
    b.add(
        "cupboard",
        cupboard,
        b.wall_place(order[2], float(b.rng.uniform(-0.5, 0.5)) * half[2], 0.23 + GAP_M),
    )
    board = _paint(grey + 25.0)
    b.hang("board", order[3], float(b.rng.uniform(-0.4, 0.4)) * half[3], 1.5, (1.6, 1.0), board)
    yaw = float(b.rng.uniform(-0.6, 0.6))
    b.add("table", make.table((1.4, 0.8, 0.74), _paint(grey - 45.0)), place(0.0, 0.0, 0.0, yaw))
    return b.world("plain", seed, AMBIENT)


def _paint(grey: float) -> Material:
    colour: Bgr = (0.98 * grey, grey, grey)
    return Material(Texture("uniform", colour, 0, (64, 64)))
