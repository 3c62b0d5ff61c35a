# SPDX-License-Identifier: Apache-2.0
"""Messages of the live stream to bytes and back; PROTOCOL.md describes them for readers.

A message is one frame: topic, one space, a MessagePack map. Nothing here knows
sockets or clocks.
"""

from typing import TypeAlias

import msgspec

from edge.errors import EdgeError
from edge.geometry import se3
from edge.outputs import rows
from edge.outputs.report import FixReport, FrameReport
from edge.types import MapPose, Mat4

SCHEMA_VERSION = 1


class WireError(EdgeError):
    """A received frame is no message of this protocol."""


class Stamp(msgspec.Struct, frozen=True):
    """Head of every message."""

    schema: int
    seq: int  # counts the messages of its topic from 0; a gap is a loss
    sent_ns: int  # monotonic clock of the sending machine
    t_ns: int  # mid-exposure of the frame


class Transform(msgspec.Struct, frozen=True):
    """A pose: position, then unit quaternion with qw >= 0."""

    x: float
    y: float
    z: float
    qw: float
    qx: float
    qy: float
    qz: float


class PoseMessage(Stamp, frozen=True):
    """Topic `pose`: the camera in the map; sent for frames that have such a pose."""

    index: int
    T_map_cam: Transform
    T_map_cam_smooth: Transform
    covariance: tuple[float, ...]  # 21 upper terms: position [m^2], then rotation [rad^2]
    sigma_m: float
    scale: float
    quality: float
    reset_counter: int


class OdomMessage(Stamp, frozen=True):
    """Topic `odom`: what the odometry alone knows; sent for each frame."""

    index: int
    state: str
    odom_id: int
    T_odom_cam: Transform | None
    quality: float


class FixMessage(Stamp, frozen=True):
    """Topic `fix`: one attempt to find a frame in the map."""

    index: int
    accepted: bool
    reason: str
    matches: int
    inliers: int
    T_map_cam: Transform | None
    sigma_m: float | None
    sigma_deg: float | None
    ms: float


class StatusMessage(Stamp, frozen=True):
    """Topic `status`: how it goes; sent about once a second."""

    version: str
    state: str  # of the odometry
    localised: bool  # the newest frame has a map pose
    frames: int
    published: int
    fixes_tried: int
    fixes_accepted: int
    dropped_frames: int
    rate_hz: float
    latency_ms: float  # capture to publication, the largest since the last status


Message: TypeAlias = PoseMessage | OdomMessage | FixMessage | StatusMessage
TOPICS: dict[str, type[Message]] = {
    "pose": PoseMessage,
    "odom": OdomMessage,
    "fix": FixMessage,
    "status": StatusMessage,
}
_NAMES = {kind: name for name, kind in TOPICS.items()}
_DECODERS = {name: msgspec.msgpack.Decoder(kind) for name, kind in TOPICS.items()}
_ENCODER = msgspec.msgpack.Encoder()


def encode(message: Message) -> bytes:
    """The one frame that carries `message`."""
    return _NAMES[type(message)].encode() + b" " + _ENCODER.encode(message)


def decode(frame: bytes) -> tuple[str, Message]:
    """Topic and message of one frame; unknown keys of newer schemas are passed over."""
    topic, _, payload = frame.partition(b" ")
    name = topic.decode("ascii", "replace")
    if name not in _DECODERS:
        raise WireError(f"message of unknown topic {name[:20]!r}: subscribe to {', '.join(TOPICS)}")
    try:
        return name, _DECODERS[name].decode(payload)
    except msgspec.DecodeError as error:
        raise WireError(f"{name} message cannot be read: {error}") from error


def pose_message(report: FrameReport, pose: MapPose, seq: int, sent_ns: int) -> PoseMessage:
    """Message of a published pose."""
    return PoseMessage(
        schema=SCHEMA_VERSION,
        seq=seq,
        sent_ns=sent_ns,
        t_ns=pose.t_ns,
        index=pose.index,
        T_map_cam=_transform(pose.T_map_cam),
        T_map_cam_smooth=_transform(pose.T_map_cam_smooth),
        covariance=rows.upper_terms(pose.covariance),
        sigma_m=rows.largest_sigma(pose.covariance, 0),
        scale=pose.scale,
        quality=report.update.quality,
        reset_counter=pose.reset_counter,
    )


def odom_message(report: FrameReport, seq: int, sent_ns: int) -> OdomMessage:
    """Message of a frame's odometry."""
    update = report.update
    return OdomMessage(
        schema=SCHEMA_VERSION,
        seq=seq,
        sent_ns=sent_ns,
        t_ns=update.t_ns,
        index=update.index,
        state=update.state.value,
        odom_id=update.odom_id,
        T_odom_cam=None if update.T_odom_cam is None else _transform(update.T_odom_cam),
        quality=update.quality,
    )


def fix_message(report: FixReport, seq: int, sent_ns: int) -> FixMessage:
    """Message of a relocalisation attempt."""
    row = rows.fix_row(report)
    T_map_cam = report.fix.T_map_cam
    return FixMessage(
        schema=SCHEMA_VERSION,
        seq=seq,
        sent_ns=sent_ns,
        t_ns=row.t_ns,
        index=report.fix.index,
        accepted=row.accepted,
        reason=row.reason,
        matches=row.matches,
        inliers=row.inliers,
        T_map_cam=None if T_map_cam is None else _transform(T_map_cam),
        sigma_m=row.sigma_m,
        sigma_deg=row.sigma_deg,
        ms=row.ms,
    )


def _transform(T: Mat4) -> Transform:
    x, y, z, qx, qy, qz, qw = se3.to_tum(T).tolist()
    return Transform(x, y, z, qw, qx, qy, qz)
