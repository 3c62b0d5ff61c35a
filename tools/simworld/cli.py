# SPDX-License-Identifier: Apache-2.0
"""Make recordings of drives through one simulated room."""

import argparse
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from edge.errors import EdgeError
from edge.geometry.camera import CameraModel
from tools.simworld.changes import Change, change_room, count_views
from tools.simworld.errors import WorldError
from tools.simworld.paths import KINDS, make_path
from tools.simworld.paths import Path as CameraPath
from tools.simworld.recording import Progress, Recipe, write_recording
from tools.simworld.renderer import Renderer
from tools.simworld.rooms import STYLES, make_room
from tools.simworld.sensor import EXPOSURES, Sensor
from tools.simworld.world import World


@dataclass(frozen=True, slots=True)
class Drive:
    """One recording of a room."""

    seed: int  # added to the room's
    seconds: float
    every: int
    exact: bool  # with depth and ids
    changed: bool = False


DRIVES = {
    "map": Drive(101, 25.0, 5, exact=True),
    "query": Drive(202, 12.0, 1, exact=False),
    "changed": Drive(303, 18.0, 1, exact=False, changed=True),
}


def parser() -> argparse.ArgumentParser:
    """The command line's options."""
    p = argparse.ArgumentParser(prog="python -m tools.simworld", description=__doc__)
    p.add_argument("--out", type=Path, required=True, help="folder for the recordings")
    p.add_argument("--seed", type=int, default=1, help="of the room; drives derive theirs from it")
    p.add_argument("--look", type=int, help="seed of the materials; default: the room's")
    p.add_argument("--room", choices=STYLES, default="office")
    p.add_argument("--drives", default="map,query", help=f"some of {','.join(DRIVES)}")
    p.add_argument("--seconds", type=float, help="length of each drive; default: its own")
    p.add_argument("--path", choices=KINDS, help="default: forward in a corridor, else walk")
    p.add_argument("--rate", type=float, default=20.0, help="images per second")
    p.add_argument("--map-every", type=int, default=5, help="the map drive keeps each k-th image")
    p.add_argument("--tremor", type=float, default=1.0, help="strength of the hand's tremor")
    p.add_argument("--depth", choices=("map", "all", "none"), default="map")
    p.add_argument("--format", choices=("jpg", "png"), default="jpg")
    p.add_argument("--size", type=int, nargs=2, default=(640, 480), metavar=("W", "H"))
    p.add_argument("--focal", type=float, help="focal length [px]; default: 0.656 widths")
    p.add_argument("--distortion", default="none", metavar="MODEL:K1,K2,...")
    p.add_argument("--workers", type=int, default=1, help="threads that render")
    p.add_argument("--exposure", choices=EXPOSURES, default="fixed")
    p.add_argument("--vignette", type=float, default=0.0, help="light lost in the corners, 0 to 1")
    p.add_argument("--noise", type=float, default=0.0, help="deviation in grey values")
    p.add_argument("--blur-ms", type=float, default=0.0, help="exposure time")
    p.add_argument("--rolling-ms", type=float, default=0.0, help="read-out time of a whole image")
    return p


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit status."""
    options = parser().parse_args(arguments)
    try:
        make_drives(options)
    except (EdgeError, OSError) as error:
        print(f"simworld: {error}", file=sys.stderr)
        return 2
    return 0


def make_drives(options: argparse.Namespace) -> None:
    """Write every drive that was asked for."""
    names = [name for name in options.drives.split(",") if name]
    for name in names:
        if name not in DRIVES:
            raise WorldError(f"drive {name!r} is unknown; take some of {', '.join(DRIVES)}")
    camera = make_camera(options)
    room = make_room(options.seed, options.room, options.look)
    renderer = Renderer(room, camera)
    for name in names:
        if not DRIVES[name].changed:
            write_drive(options, name, renderer, [])
    for name in names:
        if DRIVES[name].changed:
            changed, changes = change_room(room, options.seed)
            path = drive_path(options, name, changed)
            changes = count_views(room, changed, camera, path.T_world_cam, changes)
            write_drive(options, name, Renderer(changed, camera), changes)


def drive_path(options: argparse.Namespace, name: str, world: World) -> CameraPath:
    """The path of one drive."""
    kind = options.path or ("forward" if options.room == "corridor" else "walk")
    seconds = options.seconds or DRIVES[name].seconds
    seed = options.seed * 1000 + DRIVES[name].seed
    return make_path(world, seed, seconds, options.rate, kind, options.tremor)


def write_drive(
    options: argparse.Namespace, name: str, renderer: Renderer, changes: list[Change]
) -> None:
    """Write one drive's recording."""
    drive = DRIVES[name]
    exact = options.depth == "all" or (drive.exact and options.depth == "map")
    recipe = Recipe(
        every=options.map_every if drive.every > 1 else 1,
        depth=exact,
        ids=exact,
        image_format=options.format,
        workers=options.workers,
        sensor=make_sensor(options, options.seed * 1000 + drive.seed),
        about={"drive": name, "changes": [asdict(change) for change in changes]},
    )
    path = drive_path(options, name, renderer.world)
    write_recording(options.out / name, renderer, path, recipe, bar(name))


def make_camera(options: argparse.Namespace) -> CameraModel:
    """The camera that the options describe, its axis through the middle."""
    w, h = options.size
    focal = options.focal or 0.65625 * w
    model, _, numbers = options.distortion.partition(":")
    try:
        distortion = tuple(float(n) for n in numbers.split(",") if n)
    except ValueError:
        raise WorldError(f"--distortion {options.distortion!r} is not MODEL:K1,K2,...") from None
    return CameraModel(w, h, focal, focal, 0.5 * (w - 1), 0.5 * (h - 1), model, distortion)


def make_sensor(options: argparse.Namespace, seed: int) -> Sensor:
    """The imperfections that the options ask for."""
    return Sensor(
        exposure=options.exposure,
        vignette=options.vignette,
        noise_grey=options.noise,
        blur_ms=options.blur_ms,
        rolling_ms=options.rolling_ms,
        seed=seed,
    )


def bar(name: str) -> Progress | None:
    """A progress line on a terminal, nothing elsewhere."""
    if not sys.stderr.isatty():
        return None

    def show(done: int, of: int) -> None:
        filled = 30 * done // of
        end = "\n" if done == of else ""
        line = f"\r{name:8s} [{'#' * filled}{'.' * (30 - filled)}] {done}/{of}"
        print(line, end=end, file=sys.stderr, flush=True)

    return show
