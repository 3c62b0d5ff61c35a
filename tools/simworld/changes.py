# SPDX-License-Identifier: Apache-2.0
"""The same room after people were in it: things added, removed, moved."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from edge.geometry.camera import CameraModel
from edge.types import F64
from tools.simworld.builder import LABELLED
from tools.simworld.errors import WorldError
from tools.simworld.furniture import place
from tools.simworld.objects import OBJECTS
from tools.simworld.renderer import Tracer
from tools.simworld.world import Part, Shape, Thing, World

TRIES = 300
GAP_M = 0.03  # between small things
MOVED_M = 0.5  # at least; less would be hard to tell from an error
SUPPORTS = ("desk", "table", "cupboard", "chest")
SEEN_PX = 100  # a view shows at least so much of a thing


@dataclass(frozen=True, slots=True)
class Change:
    """One thing that is no longer, or newly, at a place. A moved thing makes two of them."""

    kind: str  # added or removed
    id: int
    name: str
    label: str
    center: tuple[float, ...]  # of its box, in the world [m]
    size: tuple[float, ...]  # of its box along the world's axes [m]
    moved: bool
    views: int = 0  # frames of the changed drive that show its place unhidden
    median_px: float = 0.0  # size in those frames


def change_room(
    world: World,
    seed: int,
    added: int = 4,
    removed: int = 4,
    moved: int = 2,
    labels: Sequence[str] = LABELLED,
    sizes: tuple[float, float] = (1.0, 1.0),
) -> tuple[World, list[Change]]:
    """Another state of a room, and every difference. Ids of new things are new.

    Only things of `labels` come, go and move; what comes is as large as usual, times a factor
    between `sizes`.
    """
    rng = np.random.default_rng([seed, 555])
    bases = {t.base_id for t in world.things}
    loose = [t for t in world.things if t.movable and t.label in labels and t.id not in bases]
    if len(loose) < removed + moved:
        raise WorldError(f"only {len(loose)} things of this room can be taken away or moved")
    order = [loose[i] for i in rng.permutation(len(loose))]
    gone, wandering = order[:removed], order[removed : removed + moved]
    leaving = {t.id for t in gone + wandering}
    things = [t for t in world.things if t.id not in leaving]
    changes = [_change("removed", t, moved=False) for t in gone]
    # Nothing comes to where something was: of things exchanged on the spot nobody can be sure.
    left = gone + wandering
    for old in wandering:
        new = _put_somewhere([*things, *left], old, rng)
        things.append(new)
        changes += [_change("removed", old, moved=True), _change("added", new, moved=True)]
    last = max(t.id for t in world.things)
    for i in range(added):
        label = str(rng.choice([label for label in labels if label != "screen"]))
        parts = tuple(OBJECTS[label](rng))
        if sizes != (1.0, 1.0):
            factor = float(rng.uniform(*sizes))
            parts = tuple(_scaled(part, factor) for part in parts)
        fresh = Thing(last + 1 + i, f"{label}{last + 1 + i}", label, parts, np.eye(4), None, True)
        things.append(_put_somewhere([*things, *left], fresh, rng))
        changes.append(_change("added", things[-1], moved=False))
    things.sort(key=lambda t: t.id)
    after = World(world.style, world.seed, tuple(things), world.lamps, world.ambient, world.size_m)
    return after, changes


def _change(kind: str, thing: Thing, *, moved: bool) -> Change:
    low, high = thing.bounds()
    center, size = (0.5 * (low + high)).round(6), (high - low).round(6)
    return Change(
        kind, thing.id, thing.name, thing.label, tuple(center.tolist()), tuple(size.tolist()), moved
    )


def _scaled(part: Part, factor: float) -> Part:
    T = part.T_thing_part.copy()
    T[:3, 3] *= factor
    x, y, z = (factor * half for half in part.half_m)
    return replace(part, half_m=(x, y, z), T_thing_part=T)


def _put_somewhere(things: list[Thing], thing: Thing, rng: np.random.Generator) -> Thing:
    """The thing on a free place of some table or cupboard."""
    supports = [t for t in things if t.name.rstrip("0123456789") in SUPPORTS]
    for _ in range(TRIES):
        base = supports[int(rng.integers(len(supports)))]
        top = base.parts[0]
        if top.shape is not Shape.BOX:
            continue
        x = float(rng.uniform(-0.9, 0.9)) * top.half_m[0]
        y = float(rng.uniform(-0.8, 0.8)) * top.half_m[1]
        T_top = base.T_world_thing @ top.T_thing_part
        moved = thing.moved(T_top @ place(x, y, top.half_m[2], float(rng.uniform(-1, 1))), base.id)
        far = np.linalg.norm(moved.T_world_thing[:3, 3] - thing.T_world_thing[:3, 3]) > MOVED_M
        if far and _is_free(things, base, moved) and _lies_on(base, moved):
            return moved
    raise WorldError("no free place for another thing in this room; change less")


def _lies_on(base: Thing, thing: Thing) -> bool:
    """Whether its box does not stand out over the edge of what it stands on."""
    low, high = thing.bounds()
    top = base.parts[0]
    corners = np.array([[x, y, low[2]] for x in (low[0], high[0]) for y in (low[1], high[1])])
    T = base.T_world_thing @ top.T_thing_part
    local = (corners - T[:3, 3]) @ T[:3, :3]
    return bool((np.abs(local[:, :2]) <= top.half_m[:2]).all())


def _is_free(things: list[Thing], base: Thing, thing: Thing) -> bool:
    low, high = thing.bounds()
    for other in things:
        if other.id == base.id or other.parts[0].shape is Shape.ROOM:
            continue
        other_low, other_high = other.bounds()
        if (low - GAP_M < other_high).all() and (other_low < high + GAP_M).all():
            return False
    return True


def count_views(
    before: World,
    after: World,
    camera: CameraModel,
    poses: F64,
    changes: list[Change],
    seen_px: float = SEEN_PX,
) -> list[Change]:
    """The changes with their views of at least `seen_px` filled in for poses (n, 4, 4)."""
    shrink = 4 if min(camera.width, camera.height) >= 240 else 1
    small = CameraModel(
        camera.width // shrink, camera.height // shrink, camera.fx / shrink, camera.fy / shrink,
        (camera.cx + 0.5) / shrink - 0.5, (camera.cy + 0.5) / shrink - 0.5,
        camera.distortion_model, camera.distortion,
    )  # fmt: skip
    sizes: dict[str, F64] = {}
    for kind, world in (("removed", before), ("added", after)):
        tracer = Tracer(world, small)
        most = max(t.id for t in world.things) + 1
        seen = [np.bincount(tracer.trace(T).ids.ravel(), minlength=most) for T in poses]
        sizes[kind] = np.array(seen, dtype=np.float64) * shrink**2
    counted = []
    for change in changes:
        px = sizes[change.kind][:, change.id]
        px = px[px >= seen_px]
        median = float(np.median(px)) if len(px) else 0.0
        counted.append(replace(change, views=len(px), median_px=median))
    return counted
