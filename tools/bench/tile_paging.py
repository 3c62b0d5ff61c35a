# SPDX-License-Identifier: Apache-2.0
"""What a bound on a map's memory costs: a drive through tiles, and looks for a lost camera.

python -m tools.bench.tile_paging MAP [--bounds MB ...]

MAP is a `drive-N` that `python -m tools.bench.maps --keep DIR` leaves. Each bound is measured in
a process of its own, with the map's files dropped from the page cache first, so that every page
comes from the disk. `led`: a query every 4 m with a prior, as while driving; `lost`: without one,
every fifth. Anchor: the method of 2021 held 11.9 GB for 4541 frames.
"""

import argparse
import json
import os
import resource
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

from edge.config.relocalise import RelocaliseConfig
from edge.geometry import se3, so3
from edge.relocalise.relocaliser import Relocaliser
from edge.tiles.reader import Map, open_map
from edge.types import F64, Frame, Query
from tools.bench import maps_drive
from tools.bench.maps_measure import Asked
from tools.bench.scoring import ROOT, where_measured

BOUNDS_MB = (4, 16, 32, 64, 1000)
PRIOR_SIGMA = np.repeat((0.05, 0.01), 3)  # [m, rad]
LOST_EVERY = 5
LENGTH_M, STEP_M, ASIDE_M = 800.0, 4.0, 0.3


def main() -> None:
    """Print the table, or measure one bound."""
    parser = argparse.ArgumentParser(description="what a bound on a map's memory costs")
    parser.add_argument("map", type=Path)
    parser.add_argument("--bounds", type=int, nargs="+", default=list(BOUNDS_MB), metavar="MB")
    parser.add_argument("--one", action="store_true", help=argparse.SUPPRESS)
    parser.add_argument("--blind", action="store_true", help="read nothing ahead")
    arguments = parser.parse_args()
    if arguments.one:
        print(json.dumps(measure(arguments)))
        return
    print(where_measured())
    map_ = open_map(arguments.map)
    size = sum(tile.bytes for tile in map_.tiles) / 1e6
    print(f"{arguments.map.name}: {size:.0f} MB in {len(map_.tiles)} tiles; CPU times")
    print("faults: how often led queries had to wait for the disk")
    print(
        f"{'bound MB':>8s} {'of map MB':>9s} {'led found':>9s} {'ms':>5s} {'p95':>6s} "
        f"{'faults':>6s} {'lost found':>10s} {'ms':>5s} {'p95':>6s}"
    )
    for bound in arguments.bounds:
        for blind in (False, True) if bound == arguments.bounds[-2] else (False,):
            row = _in_a_process(arguments, bound, blind)
            print(
                f"{bound:8d} {row['held_mb']:9.1f} {row['led']:9.0f} {row['led_ms']:5.1f} "
                f"{row['led_p95']:6.1f} {row['from_disk']:6.0f} {row['lost']:10.0f} "
                f"{row['lost_ms']:5.1f} {row['lost_p95']:6.1f}   {'nothing read ahead' * blind}",
                flush=True,
            )


def _in_a_process(arguments: argparse.Namespace, bound: int, blind: bool) -> dict[str, float]:
    command = [sys.executable, "-m", "tools.bench.tile_paging", "--one", str(arguments.map)]
    command += ["--bounds", str(bound), *(["--blind"] * blind)]
    done = subprocess.run(command, cwd=ROOT, stdout=subprocess.PIPE, check=True, text=True)
    row: dict[str, float] = json.loads(done.stdout)
    return row


def measure(arguments: argparse.Namespace) -> dict[str, float]:
    """Figures of one bound."""
    street_m = open_map(arguments.map).n_keyframes * maps_drive.STEP_M
    made = maps_drive.street(street_m)
    asked = [Asked(*v) for v in maps_drive.views(made, LENGTH_M, STEP_M, ASIDE_M, seed=7)]
    _drive(open_map(arguments.map), asked[:3], arguments.map)  # compiles
    _forget(arguments.map)
    map_ = open_map(arguments.map, resident_bytes=1_000_000 * arguments.bounds[0])
    if arguments.blind:
        map_.expect = lambda place: None  # type: ignore[method-assign]
    return _drive(map_, asked, arguments.map)


def _drive(map_: Map, asked: list[Asked], folder: Path) -> dict[str, float]:
    camera, rng = map_.cameras[0], np.random.default_rng(0)
    relocaliser = Relocaliser(map_, camera, RelocaliseConfig())
    blank = np.zeros((camera.height, camera.width), np.uint8)
    ms: dict[str, list[float]] = {"led": [], "lost": []}
    found, held, faults = {"led": 0, "lost": 0}, 0.0, 0
    for number, (T, features) in enumerate(asked):
        frame = Frame(number, number, blank)
        queries = {"led": _query(frame, T, rng)}
        if number % LOST_EVERY == 0:
            queries["lost"] = Query(frame)
        for kind, query in queries.items():
            before = resource.getrusage(resource.RUSAGE_SELF).ru_majflt
            began = time.thread_time()
            attempt = relocaliser.attempt(features, query)
            ms[kind].append(1e3 * (time.thread_time() - began))
            if kind == "led":
                faults += resource.getrusage(resource.RUSAGE_SELF).ru_majflt - before
            found[kind] += attempt.reason == "ok"
            held = max(held, held_mb(folder))
    return {
        "held_mb": held,
        "from_disk": faults,
        **found,
        **{f"{kind}_ms": float(np.median(values)) for kind, values in ms.items()},
        **{f"{kind}_p95": float(np.percentile(values, 95)) for kind, values in ms.items()},
    }


def _query(frame: Frame, T: F64, rng: np.random.Generator) -> Query:
    thrown = rng.normal(size=6) * PRIOR_SIGMA
    T_prior = se3.from_rotation_translation(so3.exp(thrown[3:]) @ T[:3, :3], T[:3, 3] + thrown[:3])
    return Query(frame, T_map_cam_prior=T_prior, prior_covariance=np.diag(PRIOR_SIGMA**2))


def held_mb(folder: Path) -> float:
    """Memory of this process that files below `folder` take."""
    total, counts = 0, False
    for line in Path("/proc/self/smaps").read_text(encoding="utf-8").splitlines():
        if line[0] not in "0123456789abcdef":
            total += int(line.split()[1]) if counts and line.startswith("Rss:") else 0
        else:
            counts = str(folder.resolve()) in line
    return total * 1024 / 1e6


def _forget(folder: Path) -> None:
    """Drop the files from the page cache."""
    for path in folder.rglob("*.tile"):
        descriptor = os.open(path, os.O_RDONLY)
        os.fsync(descriptor)
        os.posix_fadvise(descriptor, 0, 0, os.POSIX_FADV_DONTNEED)
        os.close(descriptor)


if __name__ == "__main__":
    main()
