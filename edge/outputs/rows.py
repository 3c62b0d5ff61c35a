# SPDX-License-Identifier: Apache-2.0
"""The lines of a run folder's text files, as pure functions."""

import math

import msgspec
import numpy as np

from edge.geometry import se3
from edge.geometry.covariance import position_sigma, rotation_sigma
from edge.outputs.report import FixReport, FrameReport
from edge.types import ChangeEvent, Evidence, Mask, Mat4, Mat6

_UPPER = np.triu_indices(6)
_UPPER_NAMES = ("x", "y", "z", "rx", "ry", "rz")

FRAMES_HEADER = (
    "index,t_ns,state,odom_id,keyframe,track_ms,keyframe_ms,frame_ms,latency_ms,"
    "quality,sigma_m,scale,reset_counter\n"
)
COVARIANCE_HEADER = (
    ",".join(
        ["t_ns", *(f"{_UPPER_NAMES[i]}_{_UPPER_NAMES[j]}" for i, j in zip(*_UPPER, strict=True))]
    )
    + "\n"
)


def tum(t_ns: int, T_world_cam: Mat4) -> str:
    """`t_s tx ty tz qx qy qz qw`; the seconds are exact to the nanosecond."""
    sign = "-" if t_ns < 0 else ""
    seconds, nanoseconds = divmod(abs(t_ns), 1_000_000_000)
    numbers = " ".join(f"{value:.9f}" for value in se3.to_tum(T_world_cam))
    return f"{sign}{seconds}.{nanoseconds:09d} {numbers}\n"


def covariance(t_ns: int, covariance: Mat6) -> str:
    """`t_ns` and the 21 upper terms, row by row."""
    return ",".join([str(t_ns), *(f"{value:.9g}" for value in covariance[_UPPER])]) + "\n"


def frame(report: FrameReport) -> str:
    """One line of frames.csv; what is not known is left empty."""
    update, pose, timing = report.update, report.pose, report.timing
    on_map = [""] * 3
    if pose is not None:
        sigma = position_sigma(pose.covariance)
        on_map = [f"{sigma:.6f}", f"{pose.scale:.9g}", str(pose.reset_counter)]
    fields = [
        str(update.index),
        str(update.t_ns),
        update.state.value,
        str(update.odom_id),
        str(int(update.is_keyframe)),
        *(f"{ms:.3f}" for ms in timing),
        f"{update.quality:.4f}",
        *on_map,
    ]
    return ",".join(fields) + "\n"


class FixRow(msgspec.Struct, frozen=True):
    """One line of fixes.jsonl; also what `mapvo localise` gives for an image."""

    t_ns: int
    accepted: bool
    reason: str
    candidates: tuple[int, ...]
    matches: int
    inliers: int
    T_map_cam: list[list[float]] | None
    sigma_m: float | None
    sigma_deg: float | None
    lines: int  # of the inliers
    ms: float


def fix_row(report: FixReport) -> FixRow:
    """`report` as plain numbers; sigmas are those of the worst direction."""
    fix = report.fix
    covariance = fix.covariance
    if covariance is not None and not np.isfinite(covariance).all():
        covariance = None
    return FixRow(
        t_ns=fix.t_ns,
        accepted=report.accepted,
        reason=report.reason,
        candidates=tuple(int(k) for k in fix.candidates),
        matches=int(fix.matches),
        inliers=int(fix.inliers),
        T_map_cam=None if fix.T_map_cam is None else fix.T_map_cam.tolist(),
        sigma_m=None if covariance is None else position_sigma(covariance),
        sigma_deg=None if covariance is None else math.degrees(rotation_sigma(covariance)),
        lines=fix.lines,
        ms=round(fix.ms, 3),
    )


def upper_terms(covariance: Mat6) -> tuple[float, ...]:
    """The 21 upper terms, row by row."""
    return tuple(covariance[_UPPER].tolist())


class MaskRow(msgspec.Struct, frozen=True):
    """The pixels of a mask: its box, and runs of pixels row by row, outside and inside in turn."""

    left: int
    top: int
    width: int
    height: int
    runs: tuple[int, ...]  # the first is outside, and may be 0


class EvidenceRow(msgspec.Struct, frozen=True):
    """One view that speaks for a change."""

    index: int
    t_ns: int
    mask: MaskRow | None


class EvidenceRows(msgspec.Struct, frozen=True):
    """All that speaks for a change."""

    log_odds: float
    source: str  # model or geometry
    partner: int | None  # the other change of a thing that was moved
    frames: tuple[EvidenceRow, ...]


class ChangeRow(msgspec.Struct, frozen=True):
    """One line of changes.jsonl."""

    id: int
    t_ns: int
    kind: str
    label: str
    score: float
    center_map_m: tuple[float, ...]
    extent_m: tuple[float, ...]
    n_views: int
    evidence: EvidenceRows


def change_row(event: ChangeEvent) -> ChangeRow:
    """`event` as plain numbers."""
    return ChangeRow(
        id=event.id,
        t_ns=event.t_ns,
        kind=event.kind,
        label=event.label,
        score=round(event.score, 4),
        center_map_m=tuple(round(float(v), 4) for v in event.center_map_m),
        extent_m=tuple(round(float(v), 4) for v in event.extent_m),
        n_views=event.n_views,
        evidence=EvidenceRows(
            log_odds=round(event.log_odds, 4),
            source=event.source,
            partner=event.partner,
            frames=tuple(_evidence_row(one) for one in event.evidence),
        ),
    )


def _evidence_row(one: Evidence) -> EvidenceRow:
    return EvidenceRow(one.index, one.t_ns, None if one.mask is None else mask_row(one.mask))


def mask_row(mask: Mask) -> MaskRow:
    """The mask as runs."""
    inside = mask.inside.ravel()
    borders = np.flatnonzero(np.diff(inside, prepend=False))
    runs = np.diff(np.concatenate([[0], borders, [inside.size]]))
    h, w = mask.inside.shape
    return MaskRow(mask.left, mask.top, w, h, tuple(int(n) for n in runs))
