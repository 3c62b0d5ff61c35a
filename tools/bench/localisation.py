# SPDX-License-Identifier: Apache-2.0
"""How well images are found in maps: errors against truth, honesty, false fixes, time.

python -m tools.bench.localisation --pair MAP RECORDING [A:B] [--pair ...] [--stride K]
    [--mode lost|led|replay ...] [--change none|mirror|flip|dark|blur|occlude]

`lost` takes each image alone; `led` gives a prior thrown around the truth; `replay` runs the
whole pipeline and scores what it publishes. `wrong` counts poses off by more than 20 cm, or any
pose at all where the recording is not of the map's place (--foreign).
"""

import argparse
import platform
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import cv2
import numpy as np

from edge.cameras.recording import Recording, open_recording
from edge.config import Config
from edge.geometry import se3, so3
from edge.relocalise.relocaliser import Relocaliser
from edge.runtime.stages import replay_pipeline
from edge.tiles.reader import open_map
from edge.types import F64, U8, Frame, Mat4, Query

WRONG_M = 0.2
PRIOR_SIGMA = np.repeat((0.03, 0.015), 3)  # [m, rad]
TRUTH_WITHIN_NS = 20_000_000


@dataclass
class Row:
    """What one pair gave in one mode."""

    name: str
    asked: int = 0
    position_m: list[float] = field(default_factory=list)
    rotation_deg: list[float] = field(default_factory=list)
    nees: list[float] = field(default_factory=list)  # of the position, per degree of freedom
    ms: list[float] = field(default_factory=list)
    untrue: int = 0  # poses where there is no truth to compare with
    reasons: Counter[str] = field(default_factory=Counter)

    def take(self, T: Mat4, covariance: F64, truth: Mat4 | None, truth_sigma_m: float) -> None:
        """Count a pose."""
        if truth is None:
            self.untrue += 1
            return
        off = T[:3, 3] - truth[:3, 3]
        spread = covariance[:3, :3] + truth_sigma_m**2 * np.eye(3)
        self.position_m.append(float(np.linalg.norm(off)))
        self.rotation_deg.append(float(np.degrees(so3.angle(T[:3, :3] @ truth[:3, :3].T))))
        self.nees.append(float(off @ np.linalg.solve(spread, off)) / 3.0)

    def line(self, foreign: bool) -> str:
        """The row of the table."""
        found = len(self.position_m) + self.untrue
        errors = np.array(self.position_m or [np.nan])
        wrong = found if foreign else int(np.sum(errors > WRONG_M))
        return (
            f"{self.name:44s} {self.asked:5d} {found:5d} {wrong:5d} "
            f"{100 * np.median(errors):7.2f} {100 * np.percentile(errors, 95):7.2f} "
            f"{100 * errors.max():7.2f} {np.median(self.rotation_deg or [np.nan]):6.2f} "
            f"{np.mean(self.nees or [np.nan]):6.2f} "
            f"{np.median(self.ms or [np.nan]):6.1f} {np.percentile(self.ms or [np.nan], 95):6.1f}  "
            + ", ".join(f"{reason} {n}" for reason, n in self.reasons.most_common(4))
        )


HEADER = (
    f"{'map <- recording, mode':44s} {'asked':>5s} {'found':>5s} {'wrong':>5s} {'med cm':>7s} "
    f"{'p95 cm':>7s} {'max cm':>7s} {'deg':>6s} {'NEES':>6s} {'ms':>6s} {'p95':>6s}  why not"
)


def changes(rng: np.random.Generator) -> dict[str, Callable[[U8], U8]]:
    """Ways to spoil an image."""

    def occlude(image: U8) -> U8:
        out = image.copy()
        height, width = out.shape
        out[:, width // 3 :] = rng.integers(0, 256, (height, width - width // 3), np.uint8)
        return out

    return {
        "none": lambda image: image,
        "mirror": lambda image: np.ascontiguousarray(image[:, ::-1]),
        "flip": lambda image: np.ascontiguousarray(image[::-1]),
        "dark": lambda image: (image // 12).astype(np.uint8),
        "blur": lambda image: cv2.GaussianBlur(image, (0, 0), 3.0).astype(np.uint8),
        "occlude": occlude,
    }


def truth_of(recording: Recording) -> Callable[[int], Mat4 | None]:
    """Pose at a time, or None where the recording has none near it."""
    if recording.groundtruth is None:
        return lambda t_ns: None
    times, poses = recording.groundtruth

    def at(t_ns: int) -> Mat4 | None:
        nearest = int(np.argmin(np.abs(times - t_ns)))
        if abs(int(times[nearest]) - t_ns) > TRUTH_WITHIN_NS:
            return None
        pose: Mat4 = poses[nearest]
        return pose

    return at


def single_images(
    pair: list[str], mode: str, arguments: argparse.Namespace, truth_sigma_m: float
) -> Row:
    """Each image alone, with or without a prior."""
    recording = opened(pair, arguments.stride)
    relocaliser = Relocaliser(open_map(pair[0]), recording.camera, Config().relocalise)
    truth, rng = truth_of(recording), np.random.default_rng(0)
    change = changes(rng)[arguments.change]
    row = Row(f"{pair[0].split('/')[-1]} <- {'/'.join(pair[1].split('/')[-2:])}, {mode}")
    for frame in recording:
        T_true = truth(frame.t_ns)
        query = Query(Frame(frame.index, frame.t_ns, change(frame.image)))
        if mode == "led":
            if T_true is None:
                continue
            query = prior_thrown(query, T_true, rng)
        began = time.thread_time()
        fix = relocaliser.step(query)
        row.ms.append(1e3 * (time.thread_time() - began))
        row.asked += 1
        if fix.found and fix.T_map_cam is not None and fix.covariance is not None:
            row.take(fix.T_map_cam, fix.covariance, T_true, truth_sigma_m)
        else:
            row.reasons[fix.reason] += 1
    return row


def prior_thrown(query: Query, T_true: Mat4, rng: np.random.Generator) -> Query:
    """The query with a prior as far from the truth as its covariance says."""
    thrown = rng.normal(size=6) * PRIOR_SIGMA
    T = se3.from_rotation_translation(
        so3.exp(thrown[3:]) @ T_true[:3, :3], T_true[:3, 3] + thrown[:3]
    )
    return Query(query.frame, T_map_cam_prior=T, prior_covariance=np.diag(PRIOR_SIGMA**2))


def replayed(pair: list[str], arguments: argparse.Namespace, truth_sigma_m: float) -> Row:
    """The whole pipeline: what it publishes, and the fixes that it took in or not."""
    recording = opened(pair, arguments.stride)
    truth = truth_of(recording)
    row = Row(f"{pair[0].split('/')[-1]} <- {'/'.join(pair[1].split('/')[-2:])}, replay")
    with replay_pipeline(Config(), recording.camera, open_map(pair[0])) as pipeline:
        for frame in frames_changed(recording, arguments.change):
            began = time.thread_time()
            report = pipeline.step(frame)
            row.ms.append(1e3 * (time.thread_time() - began))
            row.asked += 1
            row.reasons.update(fix.reason for fix in report.fixes if not fix.accepted)
            if report.pose is not None:
                pose = report.pose
                row.take(pose.T_map_cam, pose.covariance, truth(frame.t_ns), truth_sigma_m)
    return row


def frames_changed(recording: Recording, name: str) -> Iterator[Frame]:
    """Frames of the recording, each spoilt."""
    change = changes(np.random.default_rng(0))[name]
    for frame in recording:
        yield Frame(frame.index, frame.t_ns, change(frame.image))


def opened(pair: list[str], stride: int) -> Recording:
    """Recording of a pair MAP RECORDING [A:B]."""
    frames = None
    if len(pair) > 2:
        first, last = (int(v) if v else None for v in pair[2].split(":"))
        frames = slice(first, last)
    return open_recording(pair[1], frames=frames, stride=stride)


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--pair", nargs="+", action="append", required=True)
    parser.add_argument("--mode", nargs="+", default=["lost"], choices=["lost", "led", "replay"])
    parser.add_argument("--stride", type=int, default=1)
    parser.add_argument("--change", default="none", choices=list(changes(np.random.default_rng(0))))
    parser.add_argument("--foreign", action="store_true", help="every pose is a false one")
    parser.add_argument(
        "--truth-sigma-m", type=float, default=0.0, help="of each axis of the truth"
    )
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    commit = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=False
    )
    print(f"{platform.processor() or platform.machine()}, commit {commit.stdout.strip()}")
    print(HEADER)
    wrong = False
    for pair in arguments.pair:
        for mode in arguments.mode:
            if mode == "replay":
                row = replayed(pair, arguments, arguments.truth_sigma_m)
            else:
                row = single_images(pair, mode, arguments, arguments.truth_sigma_m)
            print(row.line(arguments.foreign), flush=True)
            wrong = wrong or (arguments.foreign and bool(row.position_m or row.untrue))
    return int(wrong)


if __name__ == "__main__":
    sys.exit(main())
