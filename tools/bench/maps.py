# SPDX-License-Identifier: Apache-2.0
"""What maps cost as they grow: build time, bytes by layer, opening, retrieval, memory.

python -m tools.bench.maps [--sizes N ...] [--picture FILE.png] [--keep DIR]

Compiles simulated drives (`maps_drive`: features and geometry, no images) of up to 4541 keyframes
over 3.7 km, and measures each map in a process of its own. A `*` marks a missed bound. How good
depths from images are: `tools.bench.maps_depth`.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from pathlib import Path

import numpy as np

from edge.runtime.kernel_cache import use_kernel_cache

use_kernel_cache()

from edge.config.features import OrbConfig  # noqa: E402  # imports Numba
from edge.relocalise.features import Features  # noqa: E402
from edge.tiles.reader import open_map  # noqa: E402
from maps.build import write_map  # noqa: E402
from maps.settings import BuildSettings  # noqa: E402
from maps.survey import Survey  # noqa: E402
from maps.views import View, ViewSet  # noqa: E402
from maps.work_folder import WorkFolder  # noqa: E402
from maps.workers import open_workers  # noqa: E402
from tools.bench import maps_drive  # noqa: E402
from tools.bench.maps_picture import draw  # noqa: E402
from tools.bench.scoring import ROOT, where_measured  # noqa: E402

SIZES = (250, 500, 1000, 2000, 4541)
# Neighbours along a street: asking the words for more finds no more.
SETTINGS = BuildSettings(lens="given", similar_views=6)
# Bounds: of any map, and of the largest.
KB_A_KEYFRAME, MAP_MB, OPEN_MS, RETRIEVE_MS, RESIDENT_MB = 50.0, 230.0, 100.0, 5.0, 300.0
LARGEST = 4541
# Memory may grow by this from the middle of the largest drive to its end.
FLAT_MB = 15.0

QUERIES, ASIDE_M = 100, 0.3

Row = dict[str, float]


def main() -> None:
    """Measure and print."""
    arguments = _arguments()
    print(where_measured())
    rows: list[Row] = []
    with tempfile.TemporaryDirectory() as scratch:
        place = arguments.keep or Path(scratch)
        print(HEADER)
        for n in arguments.sizes:
            rows.append(measure(n, place / f"drive-{n}"))
            print(line(rows[-1]), flush=True)
        print(
            f"{'bound':>9s} {SPACE:>8s} {KB_A_KEYFRAME:9.0f} {MAP_MB:7.0f} {OPEN_MS:8.0f}"
            f" {RETRIEVE_MS:9.1f} {SPACE:>11s} {SPACE:>15s} {RESIDENT_MB:9.0f}"
        )
        print("anchors: 11.9 GB of memory for 4541 frames (the method of 2021); RTAB-Map 3.5 GB of")
        print(
            "database and 16 GB of memory; ORB points of a room 3.8 kB a frame of descriptors alone"
        )
        print("kB a keyframe by layer: " + layers(place / f"drive-{arguments.sizes[-1]}"))
    if arguments.picture:
        draw(rows, arguments.picture)
        print(f"picture: {arguments.picture}")


SPACE = ""
HEADER = (
    f"{'keyframes':>9s} {'build s':>8s} {'kB a kf.':>9s} {'map MB':>7s} {'open ms':>8s} "
    f"{'query ms':>9s} {'localise ms':>11s} {'found, off cm':>15s} {'memory MB':>9s} "
    f"{'half way':>9s} {'before':>7s}"
)


def measure(n: int, folder: Path) -> Row:
    """Figures of a drive of `n` keyframes."""
    length_m = n * maps_drive.STEP_M
    build_s = None
    if not folder.is_dir():
        build_s = compile_drive(length_m, folder)
    queries = folder.with_suffix(".npz")
    write_queries(length_m, queries)
    size = sum(entry.bytes for entry in open_map(folder).manifest.tiles)
    command = [sys.executable, "-m", "tools.bench.maps_measure", str(folder), str(queries)]
    done = subprocess.run(command, cwd=ROOT, stdout=subprocess.PIPE, check=True, text=True)
    row: Row = {"n": n, "build_s": build_s or float("nan"), "bytes": size}
    return {**row, **json.loads(done.stdout)}


def write_queries(length_m: float, path: Path) -> None:
    """Features of images of another run, aside of the map's, evenly spread over the drive."""
    made = maps_drive.street(length_m)
    step_m = length_m / QUERIES
    views = list(maps_drive.views(made, length_m - step_m, step_m, ASIDE_M, seed=7))
    columns = zip(*(features for _, features in views), strict=True)
    layers = dict(zip(Features._fields, map(np.concatenate, columns), strict=True))
    counts = [len(features.pixels) for _, features in views]
    np.savez(path, T_map_cam=np.array([T for T, _ in views]), counts=counts, **layers)


def compile_drive(length_m: float, folder: Path) -> float:
    """Compile a simulated drive; CPU seconds, without the simulation."""
    made = maps_drive.street(length_m)
    views, descriptions = [], []
    for number, (T, features) in enumerate(maps_drive.views(made, length_m)):
        views.append(View(0, number, 100_000_000 * number, T, 0))
        descriptions.append(maps_drive.described(features))
    camera = maps_drive.CAMERA
    chosen = ViewSet([folder.with_suffix(".recording")], [camera], views, 0, [camera])
    began = time.process_time()
    with open_workers(1) as workers:
        # A work folder that cannot be made keeps nothing.
        survey = Survey(OrbConfig(), workers, WorkFolder(folder / "none"))
        measured = survey.measure(chosen, descriptions, SETTINGS)
    write_map(measured, folder, SETTINGS, OrbConfig())
    return time.process_time() - began


def line(row: Row) -> str:
    """One line of the table."""
    n, kb = int(row["n"]), row["bytes"] / row["n"] / 1e3
    largest = n >= LARGEST
    grown = row["resident_mb"] - row["half_mb"]
    memory = row["resident_mb"] > RESIDENT_MB or (largest and grown > FLAT_MB)
    off = "-" if row["off_cm"] is None else f"{row['off_cm']:.1f}"
    return (
        f"{n:9d} {row['build_s']:8.1f} {kb:8.1f}{_star(kb > KB_A_KEYFRAME)} "
        f"{row['bytes'] / 1e6:6.1f}{_star(row['bytes'] / 1e6 > MAP_MB)} "
        f"{row['open_ms']:7.1f}{_star(row['open_ms'] > OPEN_MS)} "
        f"{row['retrieve_ms']:8.2f}{_star(row['retrieve_ms'] > RETRIEVE_MS)} "
        f"{row['localise_ms']:11.1f} {row['found']:9.0f}, {off:>4s} "
        f"{row['resident_mb']:8.0f}{_star(memory)} {row['half_mb']:8.0f} "
        f"{row['base_mb']:7.0f}"
    )


def layers(folder: Path) -> str:
    """Bytes of a keyframe, by group of layers."""
    opened, sizes = open_map(folder), defaultdict(int)
    for tile in opened.tiles:
        for name, array in tile.layers.items():
            sizes[name.partition("/")[0]] += array.nbytes
    rows = sorted(sizes.items(), key=lambda item: -item[1])
    return ", ".join(f"{name} {size / opened.n_keyframes / 1e3:.2f}" for name, size in rows)


def _star(missed: bool) -> str:
    return "*" if missed else " "


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="what maps cost as they grow")
    parser.add_argument("--sizes", type=int, nargs="+", default=list(SIZES), metavar="N")
    parser.add_argument("--picture", type=Path, metavar="FILE.png", help="draw the growth")
    parser.add_argument("--keep", type=Path, metavar="DIR", help="maps stay there, and are reused")
    return parser.parse_args()


if __name__ == "__main__":
    main()
