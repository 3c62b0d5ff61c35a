# SPDX-License-Identifier: Apache-2.0
"""Rooms of the simulator before and after people were in them, and unchanged in another light.

All that is rendered is kept in the folder given, and used again while the simulator is the same.
Cameras are small and slow (424x320, 10 Hz), so that a dozen rooms take minutes and not hours.
"""

import json
import shutil
from dataclasses import asdict, dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any

from edge.geometry.camera import CameraModel
from edge.types import F64
from tools import simworld
from tools.simworld.changes import Change, change_room, count_views
from tools.simworld.errors import WorldError
from tools.simworld.light import relit
from tools.simworld.objects import KEY_COLOURS
from tools.simworld.paths import Path as CameraPath
from tools.simworld.paths import make_path
from tools.simworld.recording import Recipe, write_recording
from tools.simworld.renderer import Renderer
from tools.simworld.rooms import make_room
from tools.simworld.sensor import Sensor
from tools.simworld.world import World

CAMERA = CameraModel(424, 320, 278.25, 278.25, 211.5, 159.5, "none", ())
RATE_HZ = 10.0
LOOK_EVERY = 2  # frames: the search for changes looks at 5 Hz
MAP_S, CHANGED_S, SAME_S = 26.0, 30.0, 60.0
MAP_EVERY = 3
WELL_PX, WELL_VIEWS = 200.0, 5  # seen well, in the images that are looked at
SIZES = (0.7, 2.0)  # times the usual
LIGHT_STOPS = 0.6
KINDS = tuple(KEY_COLOURS)


@dataclass(frozen=True, slots=True)
class Room:
    """The recordings of one room."""

    seed: int
    folder: Path

    @property
    def truth(self) -> list[dict[str, Any]]:
        """What differs in `changed`; `well` tells whether map and drive show it well."""
        found: list[dict[str, Any]] = json.loads((self.folder / "truth.json").read_text())
        return found

    def unchanged(self, number: int) -> Path:
        """A drive through the room as it was, in another light each."""
        return self.folder / (f"same-{number + 1}" if number else "same")


def make_room_drives(seed: int, folder: Path, *, same: int) -> Room:
    """Render what is not there yet: `map`, `changed`, and `same` unchanged drives."""
    room = Room(seed, folder)
    drop_stale(folder)
    before, after, changes = _states(seed)
    map_poses = _poses(before, seed, "map")[::MAP_EVERY]
    _write(folder / "map", before, seed, "map")
    if not (folder / "truth.json").exists():
        poses = _poses(after, seed, "changed")[::LOOK_EVERY]
        truth = _truth(before, after, changes, poses, map_poses)
        (folder / "truth.json").write_text(json.dumps(truth, indent=1))
    _write(folder / "changed", relit(after, seed, LIGHT_STOPS), seed, "changed")
    for number in range(same):
        light = relit(before, seed + 900 + 100 * number, LIGHT_STOPS)
        _write(room.unchanged(number), light, seed, "same", number)
    return room


def drop_stale(folder: Path) -> None:
    """Remove drives of another simulator: its things stood elsewhere, or looked different."""
    digest = sha256()
    for file in (Path(__file__), *sorted(Path(simworld.__file__).parent.glob("*.py"))):
        digest.update(file.read_bytes())
    kept = folder / "simulator.sha256"
    if folder.exists() and not (kept.exists() and kept.read_text() == digest.hexdigest()):
        shutil.rmtree(folder)
    folder.mkdir(parents=True, exist_ok=True)
    kept.write_text(digest.hexdigest())


def _states(seed: int) -> tuple[World, World, list[Change]]:
    """The room before and after; with fewer things where there is little place."""
    room = make_room(seed, "office")
    for things, moved in ((4, 2), (3, 2), (2, 2), (1, 2), (1, 1), (0, 1), (0, 0)):
        try:
            before, _ = change_room(room, seed + 5000, things, 0, 0, KINDS, SIZES)
            return before, *change_room(before, seed, things, 3, moved, KINDS, SIZES)
        except WorldError:
            continue
    raise WorldError(f"room {seed} has no place for anything")


def _truth(
    before: World, after: World, changes: list[Change], poses: F64, map_poses: F64
) -> list[dict[str, Any]]:
    live = count_views(before, after, CAMERA, poses, changes, WELL_PX)
    mapped = count_views(before, after, CAMERA, map_poses, changes, WELL_PX)
    return [
        {
            **asdict(change),
            "map_views": there.views,
            "well": min(change.views, there.views) >= WELL_VIEWS,
        }
        for change, there in zip(live, mapped, strict=True)
    ]


_SECONDS = {"map": MAP_S, "changed": CHANGED_S, "same": SAME_S}


def _poses(world: World, seed: int, drive: str) -> F64:
    return _path(world, seed, drive).T_world_cam


def _path(world: World, seed: int, drive: str, number: int = 0) -> CameraPath:
    kind = list(_SECONDS).index(drive)
    return make_path(world, seed * 10 + kind + number, _SECONDS[drive], RATE_HZ)


def _write(folder: Path, world: World, seed: int, drive: str, number: int = 0) -> None:
    if (folder / "info.json").exists():  # written last
        return
    sensor = Sensor(
        exposure=("fixed", "sine", "steps")[(seed + number) % 3] if drive != "map" else "fixed",
        exposure_stops=0.3,
        noise_grey=2.0,
        vignette=0.15,
        seed=seed * 10 + len(drive) + number,
    )
    exact = drive == "map"
    recipe = Recipe(every=MAP_EVERY if exact else 1, depth=exact, sensor=sensor)
    write_recording(folder, Renderer(world, CAMERA), _path(world, seed, drive, number), recipe)
