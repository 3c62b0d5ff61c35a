# SPDX-License-Identifier: Apache-2.0
"""What lines do for map poses: one drive in the map of another by points, by lines, by both.

python -m tools.bench.lines_whole MAP_DRIVE DRIVE [--map-frames A:B] [--every K] [--frames C:D]

Both drives have true poses in one frame. "both always" looks for lines in each query, however
certain its points are: what the others spare is seen by it. CPU times on one core.
"""

import argparse
import os
import sys
import tempfile
from pathlib import Path

for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[variable] = "1"

import cv2  # noqa: E402  # threads are counted when it loads
import msgspec  # noqa: E402
import numpy as np  # noqa: E402

from edge.cameras.recording import open_recording  # noqa: E402
from edge.cli.command_line import positive, span  # noqa: E402
from edge.config import Config  # noqa: E402
from edge.config.relocalise import RelocaliseConfig  # noqa: E402
from edge.geometry import se3, so3  # noqa: E402
from edge.tiles.reader import Map, open_map  # noqa: E402
from edge.types import OdometryState  # noqa: E402
from maps.build import BuildInput, build  # noqa: E402
from maps.settings import BuildSettings  # noqa: E402
from tools.bench.localisation_runs import Played, play  # noqa: E402
from tools.bench.scoring import where_measured  # noqa: E402

WAYS = {
    "points": RelocaliseConfig(landmarks="points"),
    "both": RelocaliseConfig(landmarks="both"),
    "both always": RelocaliseConfig(lines_above_depth_share=0.0, lines_above_deg=0.0),
    "lines": RelocaliseConfig(landmarks="lines"),
}
HEADER = (
    f"{'by':<12}{'tracked %':>10}{'with pose %':>12}{'median cm':>11}{'p95':>7}{'max':>7}"
    f"{'deg':>7}{'NEES':>6}{'ms/frame':>10}{'ms/query':>10}{'with lines %':>14}{'lines':>7}"
)


def main() -> int:
    """Print the table."""
    p = argparse.ArgumentParser(prog="python -m tools.bench.lines_whole", description=__doc__)
    p.add_argument("map_drive", type=Path)
    p.add_argument("drive", type=Path)
    p.add_argument("--map-frames", type=span)
    p.add_argument("--every", type=positive, default=1)
    p.add_argument("--frames", type=span)
    args = p.parse_args()
    cv2.setNumThreads(1)
    print(f"# {where_measured()}")
    with tempfile.TemporaryDirectory() as place:
        source = BuildInput([args.map_drive], args.map_frames, args.every)
        settings = BuildSettings(lines=True)
        report = build(source, Path(place) / "map", settings)
        lines = sum(tile.lines for tile in report.manifest.tiles)
        counts = report.manifest.counts
        print(f"{counts.keyframes} keyframes, {counts.points} points, {lines} lines\n{HEADER}")
        for name, config in WAYS.items():
            map_ = open_map(Path(place) / "map")
            print(_row(name, _played(args.drive, args.frames, map_, config)), flush=True)
    return 0


def _played(drive: Path, frames: slice | None, map_: Map, config: RelocaliseConfig) -> Played:
    recording = open_recording(drive, frames=frames)
    truth = recording.groundtruth
    if truth is None:
        raise SystemExit(f"{drive}: has no true poses")
    whole = msgspec.structs.replace(Config(), relocalise=config)
    return play(recording, recording.camera, map_, truth.pose_at, whole)


def _row(name: str, played: Played) -> str:
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
    return (
        f"{name:<12}{100 * np.mean(states[first:]):>10.1f}{100 * len(off_cm) / n:>12.1f}"
        f"{median:>11.2f}{p95:>7.2f}{most:>7.2f}{np.median(deg) if deg else np.nan:>7.3f}"
        f"{np.mean(nees) if nees else np.nan:>6.2f}{1e3 * played.cpu_s / n:>10.1f}"
        f"{np.median([fix.ms for fix in fixes]) if fixes else np.nan:>10.1f}"
        f"{100 * len(by_lines) / max(len(fixes), 1):>14.0f}"
        f"{np.median(by_lines) if by_lines else 0:>7.0f}"
    )


if __name__ == "__main__":
    sys.exit(main())
