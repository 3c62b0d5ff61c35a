# SPDX-License-Identifier: Apache-2.0
"""A small corner of a room and a whole office, painted once for all tests."""

import numpy as np
import pytest

from edge.geometry.camera import CameraModel
from tools.simworld.builder import Builder
from tools.simworld.furniture import place, table
from tools.simworld.look import Look
from tools.simworld.renderer import Renderer
from tools.simworld.rooms import make_room
from tools.simworld.world import World

SMALL = CameraModel(160, 120, 105.0, 105.0, 79.5, 59.5)


def make_corner(seed: int = 1) -> World:
    """A bare room of 4 m x 4 m with a table, three things on it and a ball below."""
    b = Builder((4.0, 4.0, 2.5), seed, Look(seed, paint="plain"))
    b.shell(b.look.walls(), b.look.floor(), b.look.ceiling())
    b.ceiling_lamp(0.0, 0.0)
    desk = b.add("desk", table((1.6, 0.8, 0.7), b.look.wood()), place(0, 1.2, 0, 0.2))
    for x, label in ((-0.5, "mug"), (0.0, "figurine"), (0.5, "carton")):
        b.put(label, desk, place(0, 1.2, 0, 0.2), x, 0.0, 0.7, 0.3)
    b.put("ball", b.things[0], np.eye(4), 0.2, 0.3, 0.0, 0.0)
    b.put("ball", b.things[0], np.eye(4), -0.9, 0.9, 0.0, 0.0)
    return b.world("office", seed)


@pytest.fixture(scope="session")
def corner() -> Renderer:
    return Renderer(make_corner(), SMALL)


@pytest.fixture(scope="session")
def office() -> Renderer:
    return Renderer(make_room(1), SMALL)
