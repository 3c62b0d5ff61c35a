# SPDX-License-Identifier: Apache-2.0
"""Whole runs: in thinned maps, in one of several drives, with another camera; and as in 2021.

python -m tools.bench.localisation_setups DATA [--only thinned|drives|camera|turns ...]
    [--every N ...] [--maps FOLDER] [--pictures FOLDER]

The method of 2021 is ours by configuration: the best keyframe alone, no gate but ten inliers, the
plain mean of depth ratios, every fix believed. `cut`: the query is resampled to another camera,
smaller, off centre and with a lens that bends, which the map has never seen. `turns`: a simulated
robot drives straight, stops, turns on the spot and drives on.
"""

import argparse
import math
import sys
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

import cv2
import msgspec
import numpy as np

from edge.cameras.recording import open_recording
from edge.config import Config
from edge.config.registration import RegistrationConfig
from edge.geometry.camera import CameraModel
from edge.runtime.kernel_cache import use_kernel_cache
from edge.runtime.warm_up import warm_up
from edge.tiles.reader import Map, open_map
from edge.types import Frame
from maps.build import BuildInput, build
from maps.settings import BuildSettings
from tools.bench.localisation import truth_of
from tools.bench.localisation_picture import draw
from tools.bench.localisation_runs import Played, corrections_m, play, score
from tools.bench.localisation_thinned import SEED
from tools.bench.odometry import make_world
from tools.bench.scoring import where_measured

SEED_RUN = Config(
    relocalise=msgspec.structs.replace(SEED, scale_mean_ratio=True, scale_common=0.001),
    registration=RegistrationConfig(
        first_agreeing=1,
        first_of_last=1,
        publish_fixes=1,
        overrule_agreeing=1,
        overrule_of_last=1,
        held_fixes=1,
        gate_probability=1.0 - 1e-9,
        publish_sigma_depth_share=10.0,
        publish_sigma_deg=180.0,
    ),
)
METHODS = {"seed": SEED_RUN, "ours": Config()}
EVERY = (1, 3, 5, 7, 10, 20)
# Arguments of `python -m tools.simworld`; a change of them needs a new name.
WORLDS = {
    "robot": "--seed 71 --path robot --seconds 40 --map-every 4 --drives map,query --noise 2 "
    "--blur-ms 8 --depth none",
}
JUMPS_CM = (0.1, 0.3, 1.0, 3.0, 10.0, 30.0)


class Setup(NamedTuple):
    """A map and a drive through it."""

    name: str
    map_of: tuple[str, ...]  # recordings
    frames: slice | None
    every: int
    query: tuple[str, slice | None]
    truth_sigma_m: float = 0.0
    cut: bool = False  # another camera


KITCHEN = ("redkitchen",)


def setups(every: Iterable[int]) -> dict[str, list[Setup]]:
    """All of them, by group."""
    rest = ("redkitchen", slice(300, 500))
    walk = ("office/query", None)
    return {
        "thinned": [
            Setup(f"kitchen, every {n}", KITCHEN, slice(0, 300), n, rest, 0.005) for n in every
        ],
        "drives": [
            Setup("office, map", ("office/map",), None, 1, walk),
            Setup("office, changed", ("office/changed",), None, 2, walk),
            Setup("office, both", ("office/map", "office/changed"), None, 2, walk),
        ],
        "camera": [
            Setup("kitchen", KITCHEN, slice(0, 300), 5, rest, 0.005),
            Setup("kitchen, cut", KITCHEN, slice(0, 300), 5, rest, 0.005, cut=True),
            Setup("office, map", ("office/map",), None, 1, walk),
            Setup("office, cut", ("office/map",), None, 1, walk, cut=True),
        ],
        "turns": [Setup("robot", ("robot/map",), None, 1, ("robot/query", None))],
    }


def other_camera(camera: CameraModel) -> CameraModel:
    """Four fifths of the resolution, a tenth cut off on one side, with a lens that bends."""
    width, height = 8 * int(camera.width * 0.72 / 8), 8 * int(camera.height * 0.72 / 8)
    return CameraModel(
        width,
        height,
        0.8 * camera.fx,
        0.8 * camera.fy,
        0.55 * width,
        0.48 * height,
        "radtan",
        (-0.12, 0.03, 0.0005, -0.0005),
    )


def seen_by(frames: Iterable[Frame], camera: CameraModel, other: CameraModel) -> Iterator[Frame]:
    """The frames as another camera in the same place would give them."""
    v, u = np.mgrid[: other.height, : other.width].astype(np.float64)
    ideal = other.undistort(other.normalise(np.column_stack((u.ravel(), v.ravel()))))
    source = camera.denormalise(camera.distort(ideal)).astype(np.float32)
    map_u, map_v = source.T.reshape(2, other.height, other.width)
    for frame in frames:
        image = cv2.remap(frame.image, map_u, map_v, cv2.INTER_AREA | cv2.INTER_LINEAR)
        yield Frame(frame.index, frame.t_ns, image)


def folder_of(name: str, data: Path, maps: Path) -> Path:
    """Where a recording lies; simulated ones are made beside the maps if they are not there yet."""
    world = name.split("/")[0]
    if world not in WORLDS:
        return data / name
    make_world(WORLDS[world], maps / world)
    return maps / name


def map_for(setup: Setup, data: Path, maps: Path) -> Map:
    """Map of a setup, built if it is not there yet."""
    span = "" if setup.frames is None else f"-{setup.frames.start}-{setup.frames.stop}"
    folder = maps / ("+".join(setup.map_of).replace("/", "-") + f"{span}-{setup.every}")
    if not folder.exists():
        source = BuildInput(
            [folder_of(name, data, maps) for name in setup.map_of], setup.frames, setup.every
        )
        build(source, folder, BuildSettings())
    return open_map(folder)


def run(setup: Setup, data: Path, maps: Path, config: Config) -> Played:
    """Replay the drive in the map."""
    recording = open_recording(folder_of(setup.query[0], data, maps), frames=setup.query[1])
    camera, frames = recording.camera, iter(recording)
    if setup.cut:
        camera = other_camera(recording.camera)
        frames = seen_by(recording, recording.camera, camera)
    return play(frames, camera, map_for(setup, data, maps), truth_of(recording), config)


def jumps(played: Played) -> str:
    """How often the exact stream was moved by so much by correction, not by the odometry."""
    cm = 100.0 * corrections_m(played.reports, lambda pose: pose.T_map_cam)
    edges = (0.0, *JUMPS_CM, math.inf)
    counts = np.histogram(cm, edges)[0]
    named = (f"<{edge:g}" for edge in edges[1:-1])
    return ", ".join(f"{name}: {n}" for name, n in zip((*named, "more"), counts, strict=True))


def main() -> int:
    """Print all runs."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("data", type=Path)
    groups = ("thinned", "drives", "camera", "turns")
    parser.add_argument("--only", nargs="+", default=groups, choices=groups)
    parser.add_argument("--every", type=int, nargs="+", default=list(EVERY))
    parser.add_argument("--maps", type=Path, help="where maps are built and kept")
    parser.add_argument("--pictures", type=Path, help="a picture of each run goes there")
    arguments = parser.parse_args()
    use_kernel_cache()
    cv2.setNumThreads(1)
    warm_up(Config())
    print(where_measured())
    with tempfile.TemporaryDirectory() as made:
        for group in arguments.only:
            print(f"\n{group}; corrections of the exact stream in cm below")
            for setup in setups(arguments.every)[group]:
                for name, config in METHODS.items():
                    played = run(setup, arguments.data, arguments.maps or Path(made), config)
                    told = score(played, setup.truth_sigma_m)
                    print(f"{setup.name:20s} {name}: {told.text()}")
                    print(f"{'':26s} {jumps(played)}", flush=True)
                    if arguments.pictures:
                        file = f"{group}-{setup.name}-{name}.png".replace(", ", "-")
                        draw(played, arguments.pictures / file.replace(" ", "-"))
    return 0


if __name__ == "__main__":
    sys.exit(main())
