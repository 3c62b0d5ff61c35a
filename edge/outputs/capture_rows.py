# SPDX-License-Identifier: Apache-2.0
"""The JSON rows of a recording file; edge/capture/FORMAT.md describes them."""

from typing import Any

import msgspec

from edge.capture import format as format_
from edge.capture.writer import Schemas
from edge.geometry import se3
from edge.outputs import rows
from edge.outputs.report import FrameReport
from edge.types import Frame, Mat4


class Stamp(msgspec.Struct, frozen=True):
    """Time as viewers want it."""

    sec: int
    nsec: int


class Vector(msgspec.Struct, frozen=True):
    """Position."""

    x: float
    y: float
    z: float


class Quaternion(msgspec.Struct, frozen=True):
    """Rotation."""

    x: float
    y: float
    z: float
    w: float


class PoseParts(msgspec.Struct, frozen=True):
    """Position and rotation."""

    position: Vector
    orientation: Quaternion


class PoseRow(msgspec.Struct, frozen=True, omit_defaults=True):
    """A pose as viewers draw it; for map poses with what else is known."""

    timestamp: Stamp
    frame_id: str
    pose: PoseParts
    index: int
    covariance: tuple[float, ...] = ()
    scale: float | None = None
    reset_counter: int | None = None


class FrameRow(msgspec.Struct, frozen=True):
    """How a frame was taken."""

    index: int
    t_ns: int
    exposure_ns: int | None
    gain_db: float | None


class StateRow(msgspec.Struct, frozen=True):
    """How it goes after a frame."""

    index: int
    t_ns: int
    state: str
    odom_id: int
    is_keyframe: bool
    quality: float
    dropped_frames: int
    track_ms: float
    latency_ms: float


def schemas() -> Schemas:
    """Name and JSON Schema of each topic of rows."""
    kinds: dict[str, tuple[str, type]] = {
        format_.FRAME: ("mapvo.Frame", FrameRow),
        format_.POSE: ("foxglove.PoseInFrame", PoseRow),
        format_.ODOMETRY: ("foxglove.PoseInFrame", PoseRow),
        format_.FIX: ("mapvo.Fix", rows.FixRow),
        format_.STATE: ("mapvo.State", StateRow),
    }
    return {
        topic: (name, msgspec.json.encode(msgspec.json.schema(kind)))
        for topic, (name, kind) in kinds.items()
    }


def frame_row(frame: Frame) -> bytes:
    """How `frame` was taken."""
    return msgspec.json.encode(FrameRow(frame.index, frame.t_ns, frame.exposure_ns, frame.gain_db))


def report_rows(report: FrameReport) -> list[tuple[str, bytes]]:
    """Topics and rows of one frame's results."""
    update, pose = report.update, report.pose
    found: list[tuple[str, Any]] = [(format_.STATE, _state_row(report))]
    if update.T_odom_cam is not None:
        row = _pose_row(update.t_ns, f"odom-{update.odom_id}", update.T_odom_cam, update.index)
        found.append((format_.ODOMETRY, row))
    if pose is not None:
        row = _pose_row(pose.t_ns, "map", pose.T_map_cam, pose.index)
        more = msgspec.structs.replace(
            row,
            covariance=rows.upper_terms(pose.covariance),
            scale=float(pose.scale),
            reset_counter=int(pose.reset_counter),
        )
        found.append((format_.POSE, more))
    found += [(format_.FIX, rows.fix_row(fix)) for fix in report.fixes]
    return [(topic, msgspec.json.encode(row)) for topic, row in found]


def _state_row(report: FrameReport) -> StateRow:
    update = report.update
    return StateRow(
        index=int(update.index),
        t_ns=int(update.t_ns),
        state=update.state.value,
        odom_id=int(update.odom_id),
        is_keyframe=bool(update.is_keyframe),
        quality=float(update.quality),
        dropped_frames=int(report.dropped_frames),
        track_ms=round(report.timing.track, 3),
        latency_ms=round(report.timing.latency, 3),
    )


def _pose_row(t_ns: int, frame_id: str, T: Mat4, index: int) -> PoseRow:
    x, y, z, qx, qy, qz, qw = map(float, se3.to_tum(T))
    parts = PoseParts(Vector(x, y, z), Quaternion(qx, qy, qz, qw))
    return PoseRow(Stamp(*divmod(int(t_ns), 1_000_000_000)), frame_id, parts, int(index))
