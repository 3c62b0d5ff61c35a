# SPDX-License-Identifier: Apache-2.0
"""What lines do for map poses: one drive in the map of another by points, by lines, by both.

python -m tools.bench.lines_whole MAP_DRIVE DRIVE [--map-frames A:B] [--every K] [--frames C:D]
    [--shifts N ...] [--by WAY ...]

Both drives have true poses in one frame. "no lines" has a map built without them; "both always"
looks for lines in each query, however certain its points are: what the others spare is seen by
it. Single runs scatter by a tenth: with --shifts each way plays several that begin so many frames
later, and its row holds the means. CPU times on one core.
"""

import argparse
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

import cv2
import msgspec
import numpy as np

from edge.cameras.recording import open_recording
from edge.cli.command_line import positive, span
from edge.config import Config
from edge.config.relocalise import RelocaliseConfig
from edge.geometry import se3, so3
from edge.tiles.reader import open_map
from edge.types import F64, OdometryState
from maps.build import BuildInput, build
from maps.settings import BuildSettings
from tools.bench.localisation_runs import Played, play
from tools.bench.scoring import where_measured

WITHOUT, ALONE = "no lines", "lines"
WAYS = {
    WITHOUT: RelocaliseConfig(),
    "points": RelocaliseConfig(landmarks="points"),
    "both": RelocaliseConfig(landmarks="both"),
    "both always": RelocaliseConfig(lines_above_depth_share=0.0, lines_above_deg=0.0),
    ALONE: RelocaliseConfig(landmarks="lines"),
}
HEADER = (
    f"{'by':<12}{'tracked %':>10}{'with pose %':>12}{'median cm':>11}{'p95':>7}{'max':>7}"
    f"{'deg':>7}{'NEES':>6}{'ms/frame':>10}{'ms/query':>10}{'with lines %':>14}{'lines':>7}"
)
# Accuracy and time of a map with lines on recordings with texture, over those without.
BOUNDS = "bound: median and p95 at most 1.05, CPU at most 1.20"
_WARM_UP_FRAMES = 60  # that load all kernels before a clock runs


class Figures(NamedTuple):
    """What one run gave; nan where it has no such thing."""

    tracked: float  # [%] from the first tracked frame on
    with_pose: float  # [%]
    median_cm: float
    p95_cm: float
    max_cm: float
    deg: float
    nees: float
    ms_frame: float
    ms_query: float
    by_lines: float  # [%] of the queries
    lines: float


def main() -> int:
    """Print the table."""
    p = argparse.ArgumentParser(prog="python -m tools.bench.lines_whole", description=__doc__)
    p.add_argument("map_drive", type=Path)
    p.add_argument("drive", type=Path)
    p.add_argument("--map-frames", type=span)
    p.add_argument("--every", type=positive, default=1)
    p.add_argument("--frames", type=span, default=slice(0, None))
    p.add_argument("--shifts", type=int, nargs="+", default=[0])
    p.add_argument("--by", choices=WAYS, nargs="+", default=list(WAYS))
    args = p.parse_args()
    cv2.setNumThreads(1)
    print(f"# {where_measured()}")
    source = BuildInput([args.map_drive], args.map_frames, args.every)
    with tempfile.TemporaryDirectory() as place:
        with_lines, without = Path(place) / "lines", Path(place) / "points"
        print(_built(source, with_lines, lines=True), flush=True)
        if WITHOUT in args.by:
            build(source, without, BuildSettings())
        maps = {name: without if name == WITHOUT else with_lines for name in args.by}
        runs = _runs(args.drive, args.frames, args.shifts, maps)
    print(HEADER)
    for name, run in runs.items():
        mean = Figures(*np.mean(run, axis=0))
        print(_row(name, mean))
        if name == ALONE:
            print(f"{'':<12}{mean.ms_frame:.1f} ms a frame by lines alone (bound 33; of 2011: 65)")
    for name in runs if WITHOUT in runs else ():
        if name != WITHOUT:
            print(_against(name, np.array(runs[name]), np.array(runs[WITHOUT])))
    return 0


def _built(source: BuildInput, folder: Path, *, lines: bool) -> str:
    """Build a map; what it holds."""
    report = build(source, folder, BuildSettings(lines=lines))
    counts = report.manifest.counts
    found = sum(tile.lines for tile in report.manifest.tiles)
    return f"{counts.keyframes} keyframes, {counts.points} points, {found} lines"


def _runs(
    drive: Path, frames: slice, shifts: list[int], maps: dict[str, Path]
) -> dict[str, list[Figures]]:
    """Each way's runs; the ways take turns, as machines grow slower and faster by the minute."""
    begin = frames.start or 0
    for name, folder in maps.items():
        _played(drive, slice(begin, begin + _WARM_UP_FRAMES), folder, WAYS[name])
    runs: dict[str, list[Figures]] = {name: [] for name in maps}
    for shift in shifts:
        part = slice(begin + shift, frames.stop)
        for name, folder in maps.items():
            runs[name].append(_figures(_played(drive, part, folder, WAYS[name])))
    return runs


def _played(drive: Path, frames: slice, folder: Path, config: RelocaliseConfig) -> Played:
    recording = open_recording(drive, frames=frames)
    truth = recording.groundtruth
    if truth is None:
        raise SystemExit(f"{drive}: has no true poses")
    whole = msgspec.structs.replace(Config(), relocalise=config)
    return play(recording, recording.camera, open_map(folder), truth.pose_at, whole)


def _figures(played: Played) -> Figures:
    states = [report.update.state is OdometryState.TRACKING for report in played.reports]
    first = states.index(True) if any(states) else 0
    off_cm, deg, nees = [], [], []
    for report, T in zip(played.reports, played.truth, strict=True):
        if report.pose is None or T is None:
            continue
        away = report.pose.T_map_cam[:3, 3] - T[:3, 3]
        off_cm.append(100.0 * np.linalg.norm(away))
        deg.append(np.rad2deg(so3.angle((se3.inverse(T) @ report.pose.T_map_cam)[:3, :3])))
        nees.append(away @ np.linalg.solve(report.pose.covariance[:3, :3], away) / 3.0)
    fixes = [fix.fix for report in played.reports for fix in report.fixes]
    by_lines = [fix.lines for fix in fixes if fix.lines]
    n = len(states)
    median, p95, most = np.quantile(off_cm, (0.5, 0.95, 1.0)) if off_cm else (np.nan,) * 3
    return Figures(
        100.0 * float(np.mean(states[first:])),
        100.0 * len(off_cm) / n,
        median,
        p95,
        most,
        float(np.median(deg)) if deg else np.nan,
        float(np.mean(nees)) if nees else np.nan,
        1e3 * played.cpu_s / n,
        float(np.median([fix.ms for fix in fixes])) if fixes else np.nan,
        100.0 * len(by_lines) / max(len(fixes), 1),
        float(np.median(by_lines)) if by_lines else 0.0,
    )


def _row(name: str, f: Figures) -> str:
    return (
        f"{name:<12}{f.tracked:>10.1f}{f.with_pose:>12.1f}{f.median_cm:>11.2f}{f.p95_cm:>7.2f}"
        f"{f.max_cm:>7.2f}{f.deg:>7.3f}{f.nees:>6.2f}{f.ms_frame:>10.1f}{f.ms_query:>10.1f}"
        f"{f.by_lines:>14.0f}{f.lines:>7.0f}"
    )


def _against(name: str, runs: F64, without: F64) -> str:
    """Means over those of the map without lines, and the spread of single runs."""
    parts = []
    for title, field in (("median", "median_cm"), ("p95", "p95_cm"), ("CPU", "ms_frame")):
        at = Figures._fields.index(field)
        single = runs[:, at] / without[:, at]
        ratio = runs[:, at].mean() / without[:, at].mean()
        parts.append(f"{title} x {ratio:.2f} ({single.min():.2f} to {single.max():.2f})")
    return f"{name} / {WITHOUT}: {', '.join(parts)} ({BOUNDS})"


if __name__ == "__main__":
    sys.exit(main())
