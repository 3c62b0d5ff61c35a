# SPDX-License-Identifier: Apache-2.0
"""What edges do for the odometry in rooms of painted walls: start, track, err.

python -m tools.bench.lines_plain [--worlds FOLDER] [RECORDING ...]

Plain rooms are simulated once and kept. Each is played by points alone, with a start by edges, and
with lines in the window as well. Given recordings are played in the same ways: with texture, edges
must change nothing. "then" are frames tracked once started, "all" those with a pose at the end: a
start is followed back to the first frame. Bounds: 98 % of all, 1.5 % of the path.
"""

import argparse
import sys
import time
from pathlib import Path

import cv2
import numpy as np

from edge.cameras.recording import Recording, open_recording
from edge.config.odometry import OdometryConfig
from edge.odometry.odometry import Odometry
from edge.types import OdometryState
from tools.bench.scoring import lives, score, where_measured
from tools.simworld import cli as simworld

# Arguments of `python -m tools.simworld`.
ROOMS = {
    "20 Hz": "--seed 2 --rate 20 --noise 2 --seconds 8",
    "30 Hz": "--seed 4 --rate 30 --noise 2 --seconds 12",
    "far walls": "--seed 6 --rate 30 --noise 2 --seconds 12",
    "noise": "--seed 21 --rate 30 --noise 3 --seconds 10",
    "15 Hz": "--seed 24 --rate 15 --noise 2 --seconds 10",
    "small": "--seed 23 --rate 30 --noise 2 --seconds 10 --size 320 240",
    "blur": "--seed 26 --rate 30 --noise 2 --seconds 10 --blur-ms 8",
}
_COMMON = "--room plain --drives query --depth none --format png"
WAYS = {
    "points": OdometryConfig(start_lines=False),
    "start by edges": OdometryConfig(window_lines=False),
    "and lines": OdometryConfig(),
}
HEADER = (
    f"{'recording':<22}{'by':<16}{'first':>7}{'then %':>8}{'all %':>8}{'starts':>8}"
    f"{'cm':>8}{'% of path':>11}{'ms/frame':>10}"
)


def main() -> int:
    """Print the table."""
    p = argparse.ArgumentParser(prog="python -m tools.bench.lines_plain", description=__doc__)
    p.add_argument("recordings", nargs="*", type=Path, metavar="RECORDING")
    p.add_argument("--worlds", type=Path, default=Path("/tmp/mapvo-bench/plain"))
    args = p.parse_args()
    cv2.setNumThreads(1)
    print(f"# {where_measured()}\n{HEADER}")
    named = {str(folder.name): folder for folder in args.recordings}
    for name, folder in (named or _rooms(args.worlds)).items():
        for way, config in WAYS.items():
            print(_row(name, way, open_recording(folder), config), flush=True)
    return 0


def _rooms(worlds: Path) -> dict[str, Path]:
    """Folders of the simulated rooms, made where they are missing."""
    found = {}
    for name, arguments in ROOMS.items():
        folder = worlds / name.replace(" ", "_")
        if not (folder / "query" / "info.json").exists():  # written last
            simworld.main([*_COMMON.split(), *arguments.split(), "--out", str(folder)])
        found[f"plain room, {name}"] = folder / "query"
    return found


def _row(name: str, way: str, recording: Recording, config: OdometryConfig) -> str:
    odometry = Odometry(recording.camera, config)
    began = time.process_time()
    updates = [odometry.step(frame) for frame in recording]
    cost_ms = 1e3 * (time.process_time() - began) / len(updates)
    tracked = [update.state is OdometryState.TRACKING for update in updates]
    first = tracked.index(True) if any(tracked) else -1
    then = 100.0 * float(np.mean(tracked[first:])) if first >= 0 else 0.0
    found = lives(updates)
    known = 100.0 * sum(len(life.t_ns) for life in found) / len(updates)
    rmse, share = np.nan, np.nan
    if recording.groundtruth is not None and found:
        times, T = recording.groundtruth
        scored = score(*found[0], times, T[:, :3, 3])
        if scored is not None:
            rmse, share = 100.0 * scored.rmse_m, 100.0 * scored.rmse_m / scored.path_m
    return (
        f"{name:<22}{way:<16}{first:>7}{then:>8.1f}{known:>8.1f}{len(found):>8}"
        f"{rmse:>8.2f}{share:>11.2f}{cost_ms:>10.1f}"
    )


if __name__ == "__main__":
    sys.exit(main())
