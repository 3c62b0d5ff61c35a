# SPDX-License-Identifier: Apache-2.0
"""One recording through the whole pipeline with a map, scored frame by frame against truth."""

import itertools
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field

import numpy as np

from edge.config import Config
from edge.geometry import se3, so3
from edge.geometry.camera import CameraModel
from edge.outputs.report import FrameReport
from edge.runtime.stages import replay_pipeline
from edge.tiles.reader import Map
from edge.types import F64, Frame, MapPose, Mat4
from tools.bench.scoring import umeyama

TruthAt = Callable[[int], Mat4 | None]  # of a time

ENOUGH_SHARE = 0.2  # of the usual number of map points: below it, silence is allowed
_VIEW_RAD = np.deg2rad(45.0)
_BORDER_PX = 19


@dataclass(eq=False)
class Played:
    """What one run gave, frame by frame; lists of equal length."""

    reports: list[FrameReport] = field(default_factory=list)
    truth: list[Mat4 | None] = field(default_factory=list)
    share: list[float] = field(default_factory=list)  # of the usual map points in view
    trajectory: list[tuple[int, Mat4]] = field(default_factory=list)
    cpu_s: float = 0.0


class Visible:
    """How many of a map's points a camera at a known pose has in view."""

    def __init__(self, map_: Map, camera: CameraModel) -> None:
        every = map_.points(np.arange(map_.n_points, dtype=np.int32))
        self._xyz, self._direction = every.xyz, every.direction.astype(np.float64)
        self._reach = every.half_angle_rad + _VIEW_RAD
        self._camera = camera.pinhole
        own = [self.count(T) for T in map_.T_map_cam[:: max(1, map_.n_keyframes // 60)]]
        self.usual = float(np.median(own))

    def count(self, T_map_cam: Mat4) -> int:
        """Points that project into the image and are seen from where the map saw them."""
        camera = self._camera
        ray = self._xyz - T_map_cam[:3, 3]
        x, y, z = (ray @ T_map_cam[:3, :3]).T
        with np.errstate(divide="ignore", invalid="ignore"):
            u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
        inside = (z > 0.0) & (u > _BORDER_PX) & (u < camera.width - _BORDER_PX)
        inside &= (v > _BORDER_PX) & (v < camera.height - _BORDER_PX)
        unit = ray / np.maximum(np.linalg.norm(ray, axis=1, keepdims=True), 1e-9)
        facing = -np.einsum("ij,ij->i", unit, self._direction)
        return int(np.count_nonzero(inside & (facing > np.cos(self._reach))))


def play(
    frames: Iterable[Frame],
    camera: CameraModel,
    map_: Map,
    truth_at: TruthAt,
    config: Config | None = None,
) -> Played:
    """Run everything; CPU time is that of this thread, without decoding."""
    played = Played()
    visible = Visible(map_, camera)
    with replay_pipeline(config or Config(), camera, map_) as pipeline:
        for frame in frames:
            began = time.thread_time()
            played.reports.append(pipeline.step(frame))
            played.cpu_s += time.thread_time() - began
            T = truth_at(frame.t_ns)
            played.truth.append(T)
            played.share.append(0.0 if T is None else visible.count(T) / visible.usual)
        played.trajectory = pipeline.trajectory()
    return played


@dataclass(frozen=True)
class Score:
    """The figures that a run is judged by; errors in cm and degrees."""

    frames: int
    published: int
    share_after_first: float
    first_after_s: float  # from the first frame with enough map to the first pose
    enough: F64  # errors on frames with enough map in view
    enough_deg: F64
    scarce: F64  # on the others
    scarce_sigmas: F64  # those errors in published sigmas
    nees: float  # per degree of freedom
    scale_off: float  # of the published path against the truth
    smooth_jump_cm: float  # greatest movement of the smooth stream by correction
    resets: int
    live_rmse: float
    final_rmse: float
    ms_a_frame: float
    reloc_ms: F64
    reasons: Counter[str]

    def text(self) -> str:
        """One line."""
        e, s = self.enough, self.scarce
        return (
            f"{self.published:4d}/{self.frames:<4d} {100 * self.share_after_first:5.1f}% "
            f"first {self.first_after_s:5.2f}s | med {median(e):5.2f} p95 {p95(e):5.2f} "
            f"max {greatest(e):6.2f} cm {median(self.enough_deg):5.2f} deg | "
            f"scarce n {len(s):3d} p95 {p95(s):5.2f} "
            f"3sig {np.mean(self.scarce_sigmas <= 3.0) if len(s) else 1.0:4.2f} | "
            f"NEES {self.nees:5.2f} scale {100 * self.scale_off:+5.2f}% "
            f"jump {self.smooth_jump_cm:4.2f} cm/{self.resets} | "
            f"live {self.live_rmse:5.2f} final {self.final_rmse:5.2f} cm | "
            f"{self.ms_a_frame:4.1f} ms, reloc p95 {p95(self.reloc_ms):4.1f} | "
            + ", ".join(f"{reason} {n}" for reason, n in self.reasons.most_common(3))
        )


def median(values: F64) -> float:
    """Median, or nan of nothing."""
    return float(np.median(values)) if len(values) else float("nan")


def p95(values: F64) -> float:
    """95th percentile, or nan of nothing."""
    return float(np.percentile(values, 95)) if len(values) else float("nan")


def greatest(values: F64) -> float:
    """Maximum, or nan of nothing."""
    return float(values.max()) if len(values) else float("nan")


def score(played: Played, truth_sigma_m: float = 0.0) -> Score:
    """Judge a run."""
    rows = list(_published(played, truth_sigma_m))
    enough = np.array([r.share >= ENOUGH_SHARE for r in rows], bool)
    cm = np.array([100.0 * r.error_m for r in rows])
    deg = np.array([r.error_deg for r in rows])
    sigmas = np.array([r.sigmas for r in rows])
    first = next((n for n, r in enumerate(played.reports) if r.pose is not None), None)
    able = next((n for n, share in enumerate(played.share) if share >= ENOUGH_SHARE), None)
    reports = played.reports
    waited = float("nan")
    if first is not None and able is not None:
        waited = abs(reports[first].update.t_ns - reports[able].update.t_ns) * 1e-9
        waited = waited if first > able else 0.0
    published = sum(r.pose is not None for r in reports)
    after = 0 if first is None else len(reports) - first
    final = dict(played.trajectory)
    live, again = _same_frames(played, final)
    fixes = [fix for r in reports for fix in r.fixes]
    return Score(
        len(reports),
        published,
        published / max(after, 1),
        waited,
        cm[enough],
        deg[enough],
        cm[~enough],
        sigmas[~enough],
        float(np.mean([r.nees for r in rows])) if rows else float("nan"),
        _scale_off(played),
        100.0 * float(corrections_m(reports, lambda pose: pose.T_map_cam_smooth).max(initial=0.0)),
        max((r.pose.reset_counter for r in reports if r.pose is not None), default=0),
        live,
        again,
        1e3 * played.cpu_s / max(len(reports), 1),
        np.array([fix.fix.ms for fix in fixes]),
        Counter(fix.reason.split(",")[0] for fix in fixes if not fix.accepted),
    )


@dataclass(frozen=True)
class _Row:
    share: float
    error_m: float
    error_deg: float
    sigmas: float
    nees: float


def _published(played: Played, truth_sigma_m: float) -> Iterator[_Row]:
    for report, T, share in zip(played.reports, played.truth, played.share, strict=True):
        if report.pose is None or T is None:
            continue
        off = report.pose.T_map_cam[:3, 3] - T[:3, 3]
        spread = report.pose.covariance[:3, :3] + truth_sigma_m**2 * np.eye(3)
        square = float(off @ np.linalg.solve(spread, off))
        error = float(np.linalg.norm(off))
        # Along its own direction: how many sigmas the error is.
        sigma = np.sqrt(off @ spread @ off) / max(error, 1e-12)
        turn = so3.angle(report.pose.T_map_cam[:3, :3] @ T[:3, :3].T)
        yield _Row(share, error, float(np.degrees(turn)), error / float(sigma), square / 3.0)


def _same_frames(played: Played, final: dict[int, Mat4]) -> tuple[float, float]:
    """RMSE [cm] of the live poses and of the final trajectory, on frames that have both."""
    live, again = [], []
    for report, T in zip(played.reports, played.truth, strict=True):
        if report.pose is not None and T is not None and report.update.t_ns in final:
            live.append(report.pose.T_map_cam[:3, 3] - T[:3, 3])
            again.append(final[report.update.t_ns][:3, 3] - T[:3, 3])
    if not live:
        return float("nan"), float("nan")
    return tuple(
        100.0 * float(np.sqrt(np.mean(np.sum(np.square(e), axis=1)))) for e in (live, again)
    )  # type: ignore[return-value]


def _scale_off(played: Played) -> float:
    """How much too long the published path is, after the best similarity."""
    pairs = [
        (r.pose.T_map_cam[:3, 3], T[:3, 3])
        for r, T in zip(played.reports, played.truth, strict=True)
        if r.pose is not None and T is not None
    ]
    if len(pairs) < 6:
        return float("nan")
    mine, true = np.array(pairs).transpose(1, 0, 2)
    return 1.0 / umeyama(mine, true).s - 1.0


def corrections_m(reports: list[FrameReport], stream: Callable[[MapPose], Mat4]) -> F64:
    """Steps (n,) [m] of a stream of poses that the odometry did not make, but for resets."""
    steps = []
    for before, now in itertools.pairwise(reports):
        a, b = before.pose, now.pose
        if a is None or b is None or a.reset_counter != b.reset_counter:
            continue
        T_a, T_b = before.update.T_odom_cam, now.update.T_odom_cam
        if np.isnan(b.scale):  # from the map alone
            continue
        if T_a is None or T_b is None or before.update.odom_id != now.update.odom_id:
            continue
        step = se3.inverse(T_a) @ T_b
        step[:3, 3] *= b.scale
        foretold = stream(a) @ step
        steps.append(float(np.linalg.norm(stream(b)[:3, 3] - foretold[:3, 3])))
    return np.array(steps)
