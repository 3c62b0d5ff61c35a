# SPDX-License-Identifier: Apache-2.0
"""Rooms: where furniture stands and what lies on it."""

import math
from collections.abc import Sequence

from edge.types import F64
from tools.simworld import furniture as make
from tools.simworld.builder import GAP_M, Builder
from tools.simworld.corridor import corridor
from tools.simworld.errors import WorldError
from tools.simworld.furniture import place
from tools.simworld.look import Look
from tools.simworld.plain import plain_room
from tools.simworld.world import Shape, Thing, World

STYLES = ("office", "lines", "plain", "corridor")
PAINTS = {"lines": "plain", "plain": "uniform"}
DESK_Z = 0.74
FLAT_M = 0.013  # rugs are lower


def make_room(seed: int, style: str = "office", look_seed: int | None = None) -> World:
    """A furnished room. The same seed gives the same room.

    `style` is one of STYLES: `office` is textured all over, `lines` has the same
    furniture without any texture, `plain` has little furniture, all of one paint, `corridor`
    is 24 m long. Rooms of equal `look_seed` wear the same materials and posters in another
    arrangement.
    """
    if style not in STYLES:
        raise WorldError(f"room style {style!r} is unknown; take one of {', '.join(STYLES)}")
    look = Look(seed if look_seed is None else look_seed, paint=PAINTS.get(style))
    if style == "corridor":
        return corridor(seed, look)
    if style == "plain":
        return plain_room(seed, look)
    return office(seed, look, style)


def office(seed: int, look: Look, style: str) -> World:
    """About 6 m x 5 m with desks, shelves, a table in the middle, and things on them."""
    b = Builder((6.4, 5.4, 2.7), seed, look)
    b.shell(look.walls(), look.floor(), look.ceiling())
    for x, y in ((-1.5, -1.0), (1.5, -1.0), (0.0, 1.3)):
        b.ceiling_lamp(x, y)
    _middle(b)
    walls = [int(w) for w in b.rng.permutation(4)]
    _window_wall(b, walls[0])
    _desk_wall(b, walls[1])
    _shelf_wall(b, walls[2])
    _door_wall(b, walls[3])
    if not b.look.bare:
        _on_the_floor(b)
    return b.world(style, seed)


def _middle(b: Builder) -> None:
    """A rug, a table and chairs."""
    x, y = (float(v) for v in b.rng.uniform(-0.3, 0.3, 2))
    yaw = float(b.rng.uniform(-0.5, 0.5))
    T = place(x, y, 0.0, yaw)
    colour = b.look.pale()
    rug_turn = place(x, y, 0.0, float(b.rng.normal(0, 0.2)))
    b.add("rug", make.rug(2.4, 1.8, b.look.seed(), colour), rug_turn)
    table = b.add("table", make.table((1.5, 0.8, DESK_Z), b.look.wood()), T)
    _clutter(b, table, T, 1.4, 0.7, 6, back=False)
    wood = b.look.wood()
    for cx, cy, turn in ((-0.4, -0.62, math.pi), (0.4, -0.7, math.pi), (-0.35, 0.65, 0.0)):
        wobble = float(b.rng.normal(0, 0.25))
        b.add("chair", make.wooden_chair(wood), T @ place(cx, cy, 0.0, turn + wobble))


def _clutter(
    b: Builder, base: Thing, T: F64, width: float, depth: float, count: int, *, back: bool
) -> None:
    """Small things side by side on a surface; tall ones at the back if it has a wall."""
    kinds = ["mug", "papers", "book", "figurine", "carton", "can", "papers", "keyboard"]
    if b.look.bare:
        count = (count + 2) // 3
    order = [kinds[i % len(kinds)] for i in b.rng.permutation(len(kinds))]
    step = width / count
    for i in range(count):
        x = -0.5 * width + (i + 0.5) * step + float(b.rng.uniform(-0.15, 0.15)) * step
        y = float(b.rng.uniform(-0.32, 0.05 if back else 0.32)) * depth
        b.put(order[i % len(order)], base, T, x, y, DESK_Z, float(b.rng.uniform(-0.6, 0.6)))


def _desk(b: Builder, wall: int, along: float, wood_seed: int) -> None:
    """A desk at a wall with a screen, clutter, drawers below and a chair before it."""
    depth = 0.72
    T = b.wall_place(wall, along, 0.5 * depth + GAP_M)
    desk = b.add("desk", make.table((1.5, depth, DESK_Z), b.look.wood()), T)
    first = "screen" if b.rng.random() < 0.7 else "laptop"
    turn = float(b.rng.normal(0, 0.15))
    shift = float(b.rng.uniform(-0.3, 0.3))
    b.put(first, desk, T, shift, 0.17 if first == "screen" else 0.02, DESK_Z, turn)
    b.put("lamp", desk, T, 0.62 if shift < 0 else -0.62, 0.22, DESK_Z, 0.0)
    for x in (-0.6, -0.42, 0.42, 0.6):
        kind = ("mug", "carton", "figurine", "book", "can", "papers")[b.rng.integers(6)]
        y = float(b.rng.uniform(-0.25, 0.0))
        b.put(kind, desk, T, x + 0.3 * shift, y, DESK_Z, float(b.rng.uniform(-0.6, 0.6)))
    if first == "screen":
        b.put("keyboard", desk, T, shift, -0.16, DESK_Z, float(b.rng.normal(0, 0.08)))
    drawers = make.drawer_unit(wood_seed, (150.0, 170.0, 186.0))
    b.add("drawers", drawers, T @ place(0.5 if shift < 0 else -0.5, 0.05, 0.0))
    seat = T @ place(0.2 * shift, -0.62, 0.0, math.pi + float(b.rng.normal(0, 0.4)))
    b.add("chair", make.office_chair(b.look.cloth()), seat)


def _desk_wall(b: Builder, wall: int) -> None:
    """Two desks, with boards and posters above."""
    half = 0.5 * b.length(wall)
    for side in (-1, 1):
        _desk(b, wall, side * 0.47 * half, b.look.seed())
    b.hang("notes", wall, -0.5 * half, 1.75, (1.3, 0.85), b.look.image("notes", (1024, 1024)))
    for i, z in enumerate((1.7, 1.85, 1.65)):
        w = float(b.rng.uniform(0.45, 0.6))
        b.hang("poster", wall, 0.15 + 0.72 * i, z, (w, 1.25 * w), b.look.poster())


def _shelf(b: Builder, wall: int, along: float, width: float, height: float) -> None:
    """A shelf full of books, with some objects between."""
    size = (width, 0.3, height)
    T = b.wall_place(wall, along, 0.15 + GAP_M)
    boards = round(height / 0.36)
    shelf = b.add("shelf", make.shelf(size, boards, b.look.wood()), T)
    for z in make.board_heights(size, boards)[:-1]:
        x = -0.5 * width + 0.03
        while x < 0.5 * width - 0.2:
            if b.rng.random() < 0.3:
                kind = ("mug", "figurine", "ball", "carton", "can")[b.rng.integers(5)]
                b.put(kind, shelf, T, x + 0.12, -0.02, z + 0.0125, float(b.rng.uniform(-1, 1)))
                x += 0.26
            else:
                row = min(float(b.rng.uniform(0.22, 0.5)), 0.5 * width - 0.03 - x)
                tall = float(b.rng.uniform(0.2, 0.27))
                backs = b.look.image("spines", (256, 512))
                part = make.box((row, 0.18, tall), (0, 0, 0), make.GREY, {2: backs})
                at = place(x + 0.5 * row, 0.02, z + 0.0125 + 0.5 * tall)
                b.add("books", [part], T @ at, "thing", shelf)
                x += row + 0.01


def _shelf_wall(b: Builder, wall: int) -> None:
    """Two shelves, a cupboard between, pictures over it."""
    half = 0.5 * b.length(wall)
    _shelf(b, wall, -half + 1.3, 1.1, 2.05)
    _shelf(b, wall, half - 1.35, 0.95, 1.6)
    wide = 2 * half - 1.85 - 1.825 - 0.25
    T = b.wall_place(wall, 0.0125, 0.21 + GAP_M)
    cupboard = b.add("cupboard", make.cupboard((wide, 0.42, 0.85), 3, b.look.wood()), T)
    kinds = ("figurine", "carton", "book", "ball", "mug")
    for i in range(4):
        x = -0.5 * wide + (i + 0.5) * wide / 4
        kind = kinds[b.rng.integers(len(kinds))]
        b.put(kind, cupboard, T, x, -0.04, 0.85, float(b.rng.uniform(-0.5, 0.5)))
    b.hang("picture", wall, -0.35, 1.72, (1.15, 0.8), b.look.image("photograph"))
    b.hang("poster", wall, 0.65, 1.65, (0.5, 0.7), b.look.poster())
    b.hang("poster", wall, half - 1.35, 2.1, (0.8, 0.6), b.look.poster())


def _window_wall(b: Builder, wall: int) -> None:
    """A window over a radiator, a desk beside it, plants."""
    half = 0.5 * b.length(wall)
    side = 1 if b.rng.random() < 0.5 else -1
    b.window(wall, side * 0.42 * half, 1.5)
    b.add("radiator", make.radiator(1.3), b.wall_place(wall, side * 0.42 * half, 0.07))
    _desk(b, wall, -side * 0.42 * half, b.look.seed())
    seed = b.look.seed()
    b.add("plant", make.plant(seed, 1.3), b.wall_place(wall, side * (half - 0.42), 0.4))
    for i in range(2):
        w = float(b.rng.uniform(0.4, 0.55))
        at = -side * (0.18 + 0.58 * i) * half
        b.hang("poster", wall, at, 1.75, (w, 1.3 * w), b.look.poster())


def _door_wall(b: Builder, wall: int) -> None:
    """A door, a white board, posters, a lamp in the corner."""
    half = 0.5 * b.length(wall)
    side = 1 if b.rng.random() < 0.5 else -1
    b.door(wall, side * (half - 0.95))
    b.hang(
        "whiteboard", wall, -side * 0.35, 1.5, (1.8, 1.1), b.look.image("whiteboard", (512, 1024))
    )
    b.hang("calendar", wall, side * 0.85, 1.65, (0.42, 0.6), b.look.image("document"))
    b.hang("poster", wall, -side * (half - 0.7), 1.6, (0.6, 0.85), b.look.poster())
    T = b.wall_place(wall, -side * (half - 0.45), 0.4)
    b.add("floorlamp", make.floor_lamp(), T)
    b.add("bin", make.bin_basket((90.0, 90.0, 86.0), b.look.seed()),
          b.wall_place(wall, side * 0.3, 0.25))  # fmt: skip
    low = b.wall_place(wall, -side * 0.75, 0.25 + GAP_M)
    chest = b.add("chest", make.cupboard((0.9, 0.5, DESK_Z), 2, b.look.wood()), low)
    _clutter(b, chest, low, 0.8, 0.3, 3, back=True)


def _on_the_floor(b: Builder) -> None:
    """Parcels, balls and packets in free places."""
    placed = 0
    for _ in range(300):
        x, y = (float(b.rng.uniform(-0.5, 0.5)) * (b.size[i] - 0.7) for i in (0, 1))
        if placed == 7 or not is_free(b.things, x, y, 0.36):
            continue
        kind = "parcel" if placed % 2 == 0 else ("ball", "carton", "ball")[b.rng.integers(3)]
        yaw = float(b.rng.uniform(-3, 3))
        b.put(kind, b.things[0], place(0, 0, 0), x, y, FLAT_M, yaw)
        placed += 1


def is_free(things: Sequence[Thing], x: float, y: float, radius: float) -> bool:
    """Whether nothing but flat things stands within `radius` [m] of a place on the floor."""
    for thing in things:
        low, high = thing.bounds()
        on_floor = low[2] < 0.6 and high[2] > FLAT_M and thing.parts[0].shape is not Shape.ROOM
        gap_x = max(low[0] - x, x - high[0], 0.0)
        gap_y = max(low[1] - y, y - high[1], 0.0)
        if on_floor and "skirting" not in thing.name and math.hypot(gap_x, gap_y) < radius:
            return False
    return True
