# SPDX-License-Identifier: Apache-2.0
"""Puts things into a room and numbers them."""

import math
from dataclasses import replace

import numpy as np

from edge.types import F64
from tools.simworld.furniture import GREY, WHITE, box, place
from tools.simworld.look import Look
from tools.simworld.objects import OBJECTS
from tools.simworld.world import Lamp, Material, Part, Shape, Texture, Thing, Vec, World

WALL_YAW = (0.0, math.pi, -math.pi / 2, math.pi / 2)  # north +y, south -y, east +x, west -x
LABELLED = ("ball", "mug", "carton", "figurine", "book", "screen")
GAP_M = 0.02  # between furniture and wall: the skirting board


class Builder:
    """Collects the things of one room; ids count from 1 in the order of building."""

    def __init__(self, size: Vec, seed: int, look: Look) -> None:
        self.size = size
        self.rng = np.random.default_rng([seed, 1234])
        self.look = look
        self.things: list[Thing] = []
        self.lamps: list[Lamp] = []

    def add(
        self,
        name: str,
        parts: list[Part],
        T: F64,
        label: str = "thing",
        base: Thing | None = None,
    ) -> Thing:
        """Put a thing somewhere."""
        number = len(self.things) + 1
        movable = label in LABELLED
        base_id = None if base is None else base.id
        if self.look.paint is not None:
            parts = [painted(part, self.look.paint) for part in parts]
        thing = Thing(number, f"{name}{number}", label, tuple(parts), T, base_id, movable)
        self.things.append(thing)
        return thing

    def shell(self, walls: list[Material], floor: Material, ceiling: Material) -> None:
        """The room itself, with a skirting board."""
        x, y, z = self.size
        north, south, east, west = walls
        faces = {0: west, 1: east, 2: south, 3: north, 4: floor, 5: ceiling}
        room = Part(Shape.ROOM, (x / 2, y / 2, z / 2), place(0, 0, z / 2), floor, faces)
        self.add("room", [room], np.eye(4))
        skirting = [
            box((x, 0.015, 0.07), (0, s * (y / 2 - 0.0075), 0.035), GREY) for s in (-1, 1)
        ] + [box((0.015, y, 0.07), (s * (x / 2 - 0.0075), 0, 0.035), GREY) for s in (-1, 1)]
        self.add("skirting", skirting, np.eye(4))

    def ceiling_lamp(self, x: float, y: float, power: float = 0.5) -> None:
        """A glowing panel that lights the room."""
        z = self.size[2]
        panel = Material(WHITE.texture, None, False, 1.25)
        self.add(
            "panel", [box((1.2, 0.3, 0.05), (0, 0, 0), GREY, {4: panel})], place(x, y, z - 0.03)
        )
        light = (0.94 * power, 0.99 * power, power)
        self.lamps.append(Lamp((x, y, z - 0.08), (0.6, 0.15), light))

    def length(self, wall: int) -> float:
        """How long a wall is [m]."""
        return self.size[0] if wall < 2 else self.size[1]

    def wall_place(self, wall: int, along: float, inset: float, z: float = 0.0) -> F64:
        """Frame at a wall with +y into the wall and x along it; `inset` [m] away from it."""
        yaw = WALL_YAW[wall]
        depth = 0.5 * (self.size[1] if wall < 2 else self.size[0]) - inset
        c, s = math.cos(yaw), math.sin(yaw)
        return place(c * along - s * depth, s * along + c * depth, z, yaw)

    def hang(
        self,
        name: str,
        wall: int,
        along: float,
        z: float,
        size: tuple[float, float],
        image: Material,
        rim: Material = GREY,
        thick: float = 0.02,
    ) -> Thing:
        """A flat thing on a wall, its middle at height z."""
        w, h = size
        part = box((w, thick, h), (0, 0, 0), rim, {2: image})
        return self.add(name, [part], self.wall_place(wall, along, 0.5 * thick + 0.001, z))

    def door(self, wall: int, along: float) -> None:
        """A door leaf in a frame, with a handle."""
        leaf = self.look.image("panels")
        parts = [
            box((0.86, 0.03, 2.02), (0, 0, 1.01), GREY, {2: leaf}),
            box((0.07, 0.06, 2.09), (-0.465, -0.01, 1.045), GREY),
            box((0.07, 0.06, 2.09), (0.465, -0.01, 1.045), GREY),
            box((1.0, 0.06, 0.07), (0, -0.01, 2.055), GREY),
            box((0.12, 0.03, 0.025), (0.34, -0.05, 1.03), WHITE),
        ]
        self.add("door", parts, self.wall_place(wall, along, 0.02))

    def window(self, wall: int, along: float, width: float, power: float = 0.35) -> None:
        """A bright window with a sill, which also lights the room."""
        self.hang("window", wall, along, 1.6, (width, 1.3), self.look.window(), WHITE, 0.04)
        sill = [box((width + 0.1, 0.16, 0.03), (0, 0, 0), WHITE)]
        self.add("sill", sill, self.wall_place(wall, along, 0.09, 0.92))
        T = self.wall_place(wall, along, 0.35, 1.7)
        half = (0.4 * width, 0.05) if wall < 2 else (0.05, 0.4 * width)
        light = (power, 0.93 * power, 0.84 * power)
        self.lamps.append(Lamp((float(T[0, 3]), float(T[1, 3]), 1.7), half, light))

    def put(
        self, label: str, base: Thing | None, T_base: F64, x: float, y: float, z: float, yaw: float
    ) -> Thing:
        """A small object at a place in the frame of what it stands on."""
        parts = OBJECTS[label](self.rng)
        kind = label if label in LABELLED else "thing"
        return self.add(label, parts, T_base @ place(x, y, z, yaw), kind, base)

    def world(self, style: str, seed: int, ambient: float = 0.3) -> World:
        """All of it."""
        tone = (ambient, 0.98 * ambient, 0.95 * ambient)
        return World(style, seed, tuple(self.things), tuple(self.lamps), tone, self.size)


def painted(part: Part, paint: str) -> Part:
    """The same part, its colours kept, in one paint."""

    def over(material: Material) -> Material:
        texture = Texture(paint, material.texture.colour, material.texture.seed, (64, 64))
        return replace(material, texture=texture, size_m=None)

    faces = {face: over(material) for face, material in part.faces.items()}
    return replace(part, material=over(part.material), faces=faces)
