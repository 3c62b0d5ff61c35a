# SPDX-License-Identifier: Apache-2.0
"""What lines tell: poses from far-off starts, a plane's lines, and the cost of finding them.

python -m tools.bench.lines [RECORDING ...] [--trials N] [--every K]

Without recordings only what is simulated. CPU times on one core; the bounds stand beside.
"""

import argparse
import sys
import time
from pathlib import Path

import cv2
import numpy as np

from edge.cameras.recording import open_recording
from edge.config.lines import SegmentConfig
from edge.geometry.camera import CameraModel
from edge.lines.detector import SegmentDetector
from edge.lines.line import Segments
from edge.types import U8
from tools.bench.lines_cases import plane_error_m, solved, trial
from tools.bench.scoring import where_measured

_SAME_ANGLE_DEG = 4.0
_SAME_PX = 10.0  # neighbouring images of a walk move by less
_SAME_OVERLAP = 0.5


def main() -> int:
    """Print the tables."""
    p = argparse.ArgumentParser(prog="python -m tools.bench.lines", description=__doc__)
    p.add_argument("recordings", nargs="*", type=Path, metavar="RECORDING")
    p.add_argument("--trials", type=int, default=100, help="of each kind of pose problem")
    p.add_argument("--every", type=int, default=5, help="find lines in each k-th image")
    args = p.parse_args()
    cv2.setNumThreads(1)
    print(f"# {where_measured()}")
    _poses(args.trials)
    _planes()
    for recording in args.recordings:
        _finding(recording, args.every)
    return 0


def _poses(trials: int) -> None:
    print("\nPoses from far-off starts, 1 px and 1 cm of noise (bound: 95 % up to 60 deg, n >= 8)")
    print(f"{'lines':<14}{'start':>8}{'right %':>9}{'two minima %':>14}{'rounds':>8}{'ms':>7}")
    for flat in (False, True):
        for n in (6, 8, 12, 20):
            for angle in (30.0, 60.0, 90.0):
                _pose_row(n, angle, trials, flat=flat)


def _pose_row(n: int, angle_deg: float, trials: int, *, flat: bool) -> None:
    right, two, rounds, cpu_s = 0, 0, [], 0.0
    for seed in range(trials):
        rng = np.random.default_rng([seed, n])
        case = trial(rng, n, angle_deg, flat=flat)
        began = time.process_time()
        found, minima, taken = solved(rng, case, 1.0, 0.01)
        cpu_s += time.process_time() - began
        right, two = right + found, two + (minima == 2)
        rounds.append(taken)
    name = f"{n} {'in a plane' if flat else 'in space'}"
    print(
        f"{name:<14}{angle_deg:>7.0f}°{100 * right / trials:>9.0f}{100 * two / trials:>14.0f}"
        f"{np.median(rounds):>8.0f}{1e3 * cpu_s / trials:>7.2f}",
        flush=True,
    )


def _planes() -> None:
    print("\nLines of a plane 1 m off, 0.5 px of noise: mean |Z| (bound 1.0 mm; of 2011: 1.5 mm)")
    for given, name in ((True, "poses given"), (False, "marker, then lines alone")):
        found = [plane_error_m(seed, 0.5, given_poses=given) for seed in range(20)]
        heights = 1e3 * np.array([height for height, _ in found])
        lines = np.mean([n for _, n in found])
        print(f"{name:<26}{heights.mean():>7.2f} mm, worst {heights.max():.2f}; {lines:.0f} lines")


def _finding(folder: Path, every: int) -> None:
    recording = open_recording(folder)
    camera = recording.camera
    indices = list(recording.indices)
    detector = SegmentDetector(SegmentConfig())
    cost_ms, counts, again = [], [], []
    for index in indices[:-1:every]:
        images = [recording.image(index), recording.image(index + 1)]
        if any(image is None for image in images):
            continue
        pair = []
        for image in images:
            ideal = _without_lens(np.asarray(image), camera)
            if not cost_ms:
                detector.detect(ideal)  # compiles
            began = time.process_time()
            pair.append(detector.detect(ideal))
            cost_ms.append(1e3 * (time.process_time() - began))
            counts.append(len(pair[-1].length))
        if len(pair[0].length):
            again.append(np.mean(_seen_again(*pair)))
    print(
        f"\n{folder.name}: {np.median(cost_ms):.1f} ms an image"
        f" (p95 {np.quantile(cost_ms, 0.95):.1f}),"
        f" {np.median(counts):.0f} segments, {100 * np.mean(again):.0f} % found in the next image"
        f" (OpenCV's detector at full size: 16-21 ms)",
        flush=True,
    )


def _without_lens(image: U8, camera: CameraModel) -> U8:
    if camera.distortion_model == "none":
        return image
    map_x, map_y, _ = camera.undistortion_maps()
    return np.asarray(cv2.remap(image, map_x, map_y, cv2.INTER_LINEAR), np.uint8)


def _seen_again(first: Segments, second: Segments) -> np.ndarray:
    """Whether each segment (n,) has one near to it that runs the same way and overlaps it."""
    cosine = np.cos(np.deg2rad(_SAME_ANGLE_DEG))
    same = first.direction @ second.direction.T > cosine
    away = second.middle[None] - first.middle[:, None]
    along = np.einsum("nmk,nk->nm", away, first.direction)
    across = away[..., 1] * first.direction[:, :1] - away[..., 0] * first.direction[:, 1:]
    half = 0.5 * first.length[:, None]
    reach = 0.5 * second.length[None]
    overlap = np.minimum(half, along + reach) - np.maximum(-half, along - reach)
    near = np.abs(across) < _SAME_PX
    return np.any(same & near & (overlap > _SAME_OVERLAP * 2.0 * half), axis=1)


if __name__ == "__main__":
    sys.exit(main())
