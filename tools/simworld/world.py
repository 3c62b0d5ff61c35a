# SPDX-License-Identifier: Apache-2.0
"""What a world is made of, before it is packed into arrays for the kernels."""

import enum
from dataclasses import dataclass, field, replace
from typing import TypeAlias

import numpy as np

from edge.types import F64
from tools.simworld import kernels_trace
from tools.simworld.noise import Bgr

Vec: TypeAlias = tuple[float, float, float]


class Shape(enum.IntEnum):
    """Shapes that the ray caster knows."""

    BOX = kernels_trace.BOX
    ELLIPSOID = kernels_trace.ELLIPSOID
    CYLINDER = kernels_trace.CYLINDER
    ROOM = kernels_trace.ROOM


@dataclass(frozen=True, slots=True)
class Texture:
    """A recipe for an image; equal recipes are painted once."""

    kind: str  # a name in packing.PAINTERS
    colour: Bgr = (200.0, 200.0, 200.0)
    seed: int = 0
    size_px: tuple[int, int] = (256, 256)  # (height, width), powers of two


@dataclass(frozen=True, slots=True)
class Material:
    """A texture and how it lies on a face."""

    texture: Texture
    size_m: tuple[float, float] | None = None  # width and height of one repeat; None: stretched
    turned: bool = False  # the texture's u runs along the face's second axis
    glow: float = 0.0  # above 0 the face shines by itself, gamma coded


@dataclass(frozen=True, slots=True, eq=False)
class Part:
    """One primitive of a thing."""

    shape: Shape
    half_m: Vec
    T_thing_part: F64  # (4, 4)
    material: Material
    faces: dict[int, Material] = field(default_factory=dict)  # exceptions by face number


@dataclass(frozen=True, slots=True, eq=False)
class Thing:
    """One instance: all its parts carry its id."""

    id: int
    name: str
    label: str
    parts: tuple[Part, ...]
    T_world_thing: F64  # (4, 4)
    base_id: int | None = None  # what it stands on
    movable: bool = False

    def moved(self, T_world_thing: F64, base_id: int) -> "Thing":
        """The same thing somewhere else."""
        return replace(self, T_world_thing=T_world_thing, base_id=base_id)

    def bounds(self) -> tuple[F64, F64]:
        """Lowest and highest corner (3,), (3,) of its box in the world [m]."""
        low, high = np.full(3, np.inf), np.full(3, -np.inf)
        for part in self.parts:
            T = self.T_world_thing @ part.T_thing_part
            if part.shape in (Shape.ELLIPSOID,):
                reach = np.sqrt((T[:3, :3] ** 2) @ np.square(part.half_m))
            else:
                reach = np.abs(T[:3, :3]) @ np.array(part.half_m)
            low, high = np.minimum(low, T[:3, 3] - reach), np.maximum(high, T[:3, 3] + reach)
        return low, high


@dataclass(frozen=True, slots=True)
class Lamp:
    """A flat light below the ceiling."""

    centre_m: Vec
    half_m: tuple[float, float]
    power: Bgr  # linear, at the lamp


@dataclass(frozen=True, slots=True, eq=False)
class World:
    """Things with lights; x and y are level, z is up, the floor is z = 0."""

    style: str
    seed: int
    things: tuple[Thing, ...]
    lamps: tuple[Lamp, ...]
    ambient: Bgr  # linear
    size_m: Vec  # of the room; its floor's centre is the origin

    def clearance(self, points: F64) -> F64:
        """Distance (n,) of points (n, 3) to the nearest part, negative outside the room [m]."""
        best = np.full(len(points), np.inf)
        for thing in self.things:
            for part in thing.parts:
                T = thing.T_world_thing @ part.T_thing_part
                local = np.abs((points - T[:3, 3]) @ T[:3, :3])
                gap = local - np.array(part.half_m)
                if part.shape is Shape.ROOM:
                    distance = -gap.max(axis=1)
                else:
                    distance = np.linalg.norm(np.maximum(gap, 0.0), axis=1)
                best = np.minimum(best, distance)
        return best
