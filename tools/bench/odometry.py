# SPDX-License-Identifier: Apache-2.0
"""How accurate, robust and quick the odometry is, beside the reference DSO.

python -m tools.bench.odometry [--data DIR] [--preset lean|fine|both] [--quick] [--only PART ...]

Plays recordings of --data and simulated drives (made once, kept in --worlds), each in a process
of its own on one core. RMSE is that of the live positions of the longest odometry frame after a
similarity; CPU times are those of `Odometry.step` alone. A `*` marks a missed bound.
"""

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from edge.runtime.kernel_cache import use_kernel_cache
from tools.bench.odometry_cases import CASES, DSO, WORLDS, Case
from tools.bench.scoring import ROOT, lives, score, where_measured

QUICK = ("redkitchen@50", "kitti_turn", "icl_office_kt0", "sim walk")


@dataclass
class Result:
    """What one run gave. Times in ms of CPU, memory in MB, lengths in cm."""

    frames: int
    first: int | None  # frames until the first pose
    tracked: int
    restarts: int
    rmse_cm: float | None
    drift_scale: float | None
    path_m: float | None
    mean_ms: float
    frame_ms: float
    keyframe_ms: float
    rss_mb: float

    @property
    def share(self) -> float:
        """Frames with a pose in the end, those before the start included, over all [%]."""
        return 100.0 * self.tracked / max(self.frames, 1)


HEADER = (
    f"{'recording':24s} {'frames':>6s} {'start':>5s} {'track%':>6s} {'rest.':>5s} {'RMSE cm':>8s} "
    f"{'bound':>5s} {'drift':>6s} {'mean ms':>7s} {'frame':>6s} {'keyf.':>6s} {'MB':>4s}   "
    "DSO: cm, tracked, mean, frame / keyframe ms, MB"
)


def main() -> int:
    """Print the table; 0 unless a run failed."""
    arguments = parser().parse_args()
    if arguments.one:
        print(json.dumps(asdict(run_one(arguments))))
        return 0
    presets = ("lean", "fine") if arguments.preset == "both" else (arguments.preset,)
    print(where_measured())
    failed = False
    for preset in presets:
        print(f"\n{preset}\n{HEADER}")
        for case in chosen(arguments):
            failed = print_row(case, preset, arguments) or failed
    return int(failed)


def parser() -> argparse.ArgumentParser:
    """The command line's options."""
    p = argparse.ArgumentParser(prog="python -m tools.bench.odometry", description=__doc__)
    p.formatter_class = argparse.RawDescriptionHelpFormatter
    p.add_argument("--data", type=Path, default=ROOT.parent / "shared" / "data")
    p.add_argument("--worlds", type=Path, default=Path(tempfile.gettempdir()) / "mapvo-bench")
    p.add_argument("--preset", choices=("lean", "fine", "both"), default="lean")
    p.add_argument("--quick", action="store_true", help=f"only {', '.join(QUICK)}")
    p.add_argument("--only", nargs="+", metavar="PART", help="cases whose name holds a PART")
    p.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="odometry key")
    p.add_argument("--one", help=argparse.SUPPRESS)  # the child's own case
    return p


def chosen(arguments: argparse.Namespace) -> Iterator[Case]:
    """The cases that were asked for."""
    for case in CASES:
        if arguments.quick and case.name not in QUICK:
            continue
        if arguments.only and not any(part in case.name for part in arguments.only):
            continue
        yield case


def print_row(case: Case, preset: str, arguments: argparse.Namespace) -> bool:
    """Run a case in a child process and print its row; True when it failed."""
    folder = case.folder(arguments.data, arguments.worlds)
    if case.recording in WORLDS:
        make_world(f"{WORLDS[case.recording]} --drives query", folder, "query")
    elif not folder.exists():
        print(f"{case.name:24s} skipped: {folder} is not there")
        return False
    options = ["--one", case.name, "--preset", preset]
    options += ["--data", str(arguments.data), "--worlds", str(arguments.worlds)]
    options += [part for pair in arguments.set for part in ("--set", pair)]
    done = subprocess.run(
        [sys.executable, "-m", "tools.bench.odometry", *options],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode != 0:
        print(f"{case.name:24s} FAILED: {done.stderr.strip().splitlines()[-1:]}")
        return True
    print(row(case, preset, Result(**json.loads(done.stdout.splitlines()[-1]))), flush=True)
    return False


def row(case: Case, preset: str, r: Result) -> str:
    """One line of the table."""
    bound = case.bound_cm(preset, r.path_m)
    missed = bound is not None and (r.rmse_cm is None or r.rmse_cm > bound or r.restarts > 0)
    return (
        f"{case.name:24s} {r.frames:6d} {'-' if r.first is None else r.first:>5} {r.share:6.1f} "
        f"{r.restarts:5d} {_number(r.rmse_cm, 2):>7s}{'*' if missed else ' '} "
        f"{_number(bound, 1):>5s} {_number(r.drift_scale, 3):>6s} {r.mean_ms:7.1f} "
        f"{r.frame_ms:6.1f} {r.keyframe_ms:6.1f} {r.rss_mb:4.0f}   {DSO[preset].get(case.name, '')}"
    )


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def make_world(options: str, folder: Path, drive: str = "") -> None:
    """Render a simulated world, or one drive of it, unless it is there; whole or not at all."""
    if folder.exists():
        return
    use_kernel_cache()
    from tools.simworld import cli as simworld

    print(f"rendering into {folder}", file=sys.stderr)
    folder.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=folder.parent) as draft:
        made = Path(draft) / "made"
        if simworld.main([*options.split(), "--out", str(made)]) != 0:
            raise SystemExit(f"{folder}: simworld failed")
        (made / drive).rename(folder)


# --- in the child process ---


def run_one(arguments: argparse.Namespace) -> Result:
    """Play one case in this process."""
    use_kernel_cache()
    import cv2

    from edge.cameras.recording import open_recording
    from edge.config.odometry import OdometryConfig
    from edge.odometry.odometry import Odometry

    cv2.setNumThreads(1)
    case = next(case for case in CASES if case.name == arguments.one)
    settings = dict(pair.split("=", 1) for pair in arguments.set)
    config = OdometryConfig(
        preset=arguments.preset, **{key: json.loads(value) for key, value in settings.items()}
    )
    warm_up(config)
    recording = open_recording(
        case.folder(arguments.data, arguments.worlds),
        frames=slice(case.start, None),
        stride=case.stride,
        reverse=case.reverse,
    )
    odometry = Odometry(recording.camera, config)
    updates, ms = [], []
    for n, frame in enumerate(recording):
        frame = case.change(n, frame)
        began = time.process_time()
        updates.append(odometry.step(frame))
        ms.append(1e3 * (time.process_time() - began))
    return summary(updates, np.array(ms), recording.groundtruth)


def warm_up(config: object) -> None:
    """Load every kernel, so that no compilation is in the times."""
    from edge.odometry.odometry import Odometry
    from edge.runtime.synthetic import WallDrive

    drive = WallDrive(60, blind=range(30, 38))
    odometry = Odometry(drive.camera, config)  # type: ignore[arg-type]
    for frame in drive:
        odometry.step(frame)


def summary(updates: list, ms: np.ndarray, truth: tuple | None) -> Result:  # type: ignore[type-arg]
    """Score what was played."""
    found = lives(updates)
    scored = None
    if truth is not None and found:
        scored = score(*found[0], truth[0], truth[1][:, :3, 3])
    first = next((n for n, u in enumerate(updates) if u.T_odom_cam is not None), None)
    chosen = np.array([u.is_keyframe for u in updates])
    following = np.array([u.T_odom_cam is not None for u in updates]) & ~chosen
    return Result(
        frames=len(updates),
        first=first,
        tracked=sum(len(life.t_ns) for life in found),
        restarts=max(len(found) - 1, 0),
        rmse_cm=None if scored is None else 100.0 * scored.rmse_m,
        drift_scale=None if scored is None else scored.drift_scale,
        path_m=None if scored is None else scored.path_m,
        mean_ms=float(ms.mean()),
        frame_ms=float(np.median(ms[following])) if following.any() else 0.0,
        keyframe_ms=float(np.median(ms[chosen])) if chosen.any() else 0.0,
        rss_mb=resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0,
    )


if __name__ == "__main__":
    sys.exit(main())
