# SPDX-License-Identifier: Apache-2.0
"""Messages of the live stream to bytes and back; PROTOCOL.md describes them for readers.

A message is one frame: topic, one space, a map in MessagePack or JSON. Nothing
here knows sockets or clocks.
"""

from typing import Annotated, Any, Literal, TypeAlias

import msgspec
import numpy as np

from edge.errors import EdgeError
from edge.geometry import se3
from edge.geometry.covariance import position_sigma
from edge.outputs import rows
from edge.outputs.change_message import ChangeMessage
from edge.outputs.motion import Velocity, moved
from edge.outputs.report import FixReport, FrameReport
from edge.outputs.stamp import SCHEMA_VERSION as SCHEMA_VERSION
from edge.outputs.stamp import Stamp
from edge.types import MapPose, Mat4

Format: TypeAlias = Literal["msgpack", "json"]
# NaN where it is unknown; JSON has no NaN and says null.
MaybeNaN: TypeAlias = float
Vector3: TypeAlias = tuple[MaybeNaN, MaybeNaN, MaybeNaN]
Covariance: TypeAlias = Annotated[tuple[MaybeNaN, ...], msgspec.Meta(min_length=21, max_length=21)]


class WireError(EdgeError):
    """A received frame is no message of this protocol."""


class Transform(msgspec.Struct, frozen=True):
    """A pose: position, then unit quaternion with qw >= 0."""

    x: float
    y: float
    z: float
    qw: float
    qx: float
    qy: float
    qz: float


class WelcomeMessage(msgspec.Struct, frozen=True):
    """Topic `welcome`: what a new subscriber gets first."""

    schema: int
    version: str  # of mapvo
    format: Format
    topics: tuple[str, ...]


class PoseMessage(Stamp, frozen=True):
    """Topic `pose`: the camera in the map; sent for frames that have such a pose."""

    index: int
    map: str  # which map
    T_map_cam: Transform
    T_map_cam_smooth: Transform
    T_map_cam_predicted: Transform | None  # where it is at `sent_ns`; unknown without a velocity
    age_ns: int  # from mid-exposure to `sent_ns`
    covariance: Covariance  # upper terms: position [m^2], then rotation [rad^2]
    velocity_m_s: Vector3  # in the map's axes, as are the next two
    angular_velocity_rad_s: Vector3
    velocity_covariance: Covariance
    sigma_m: float
    scale: MaybeNaN
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
    """Topic `status`: how it goes; sent about once a second, with or without frames."""

    version: str
    uptime_s: float
    map: str  # which map; empty without one
    camera: str  # starting, ok, silent, refused or ended
    camera_losses: int
    state: str  # of the odometry
    localised: bool  # the newest frame has a map pose, and it is new
    frames: int
    published: int
    fixes_tried: int
    fixes_accepted: int
    dropped_frames: int
    rate_hz: float
    latency_ms: float  # capture to publication, the largest since the last status
    level: int  # of the ladder: 0 gives up nothing
    given_up: tuple[str, ...]
    reasons: tuple[str, ...]  # why, or what is about to make it give up something
    temperature_c: float | None
    cpu_cores: float  # that all threads together kept busy since the last status
    refused_clients: int
    recorder: str  # recording, full or failed and why; empty without one
    notice: str  # the last thing a person should know, with what to do
    segmenter: str = ""  # how the model fares: ready, busy, waiting: why ...; empty without one


Message: TypeAlias = (
    WelcomeMessage | PoseMessage | OdomMessage | FixMessage | ChangeMessage | StatusMessage
)
TOPICS: dict[str, type[Message]] = {
    "welcome": WelcomeMessage,
    "pose": PoseMessage,
    "odom": OdomMessage,
    "fix": FixMessage,
    "change": ChangeMessage,
    "status": StatusMessage,
}
_NAMES = {kind: name for name, kind in TOPICS.items()}
_DECODERS = {name: msgspec.msgpack.Decoder(kind) for name, kind in TOPICS.items()}
_ENCODERS: dict[str, msgspec.msgpack.Encoder | msgspec.json.Encoder] = {
    "msgpack": msgspec.msgpack.Encoder(),
    "json": msgspec.json.Encoder(),
}
_MAYBE_NAN = (
    "scale",
    "covariance",
    "velocity_m_s",
    "angular_velocity_rad_s",
    "velocity_covariance",
)
_UPPER = np.triu_indices(6)
_UNKNOWN_3 = (float("nan"),) * 3
_UNKNOWN_21 = (float("nan"),) * 21


def encode(message: Message, format_: Format = "msgpack") -> bytes:
    """The one frame that carries `message`."""
    return _NAMES[type(message)].encode() + b" " + _ENCODERS[format_].encode(message)


def decode(frame: bytes) -> tuple[str, Message]:
    """Topic and message of one frame; unknown keys of newer schemas are passed over."""
    topic, _, payload = frame.partition(b" ")
    name = topic.decode("ascii", "replace")
    if name not in _DECODERS:
        raise WireError(f"message of unknown topic {name[:20]!r}: subscribe to {', '.join(TOPICS)}")
    try:
        if payload.startswith(b"{"):  # in MessagePack that is a number
            return name, msgspec.convert(_with_nan(msgspec.json.decode(payload)), TOPICS[name])
        return name, _DECODERS[name].decode(payload)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise WireError(f"{name} message cannot be read: {error}") from error


def json_schema() -> dict[str, Any]:
    """JSON Schema of all messages: `$defs` holds each, `topics` says which is whose."""
    refs, definitions = msgspec.json.schema_components(
        TOPICS.values(), ref_template="#/$defs/{name}"
    )
    for definition in definitions.values():
        for key in _MAYBE_NAN:
            _allow_null(definition["properties"].get(key, {}))
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": f"mapvo live stream, schema {SCHEMA_VERSION}",
        "anyOf": list(refs),
        "topics": dict(zip(TOPICS, refs, strict=True)),
        "$defs": definitions,
    }


def pose_message(
    report: FrameReport, pose: MapPose, velocity: Velocity | None, seq: int, sent_ns: int
) -> PoseMessage:
    """Message of a published pose."""
    if report.captured_ns is None:
        age_ns = round(report.timing.latency * 1e6)
    else:
        age_ns = sent_ns - report.captured_ns
    linear = angular = _UNKNOWN_3
    terms = _UNKNOWN_21
    predicted = None
    if velocity is not None:
        linear = tuple(velocity.linear_m_s.tolist())
        angular = tuple(velocity.angular_rad_s.tolist())
        terms = tuple(velocity.covariance[_UPPER].tolist())
        predicted = _transform(moved(pose.T_map_cam, velocity, age_ns * 1e-9))
    return PoseMessage(
        schema=SCHEMA_VERSION,
        seq=seq,
        sent_ns=sent_ns,
        t_ns=pose.t_ns,
        index=pose.index,
        map=report.map_name,
        T_map_cam=_transform(pose.T_map_cam),
        T_map_cam_smooth=_transform(pose.T_map_cam_smooth),
        T_map_cam_predicted=predicted,
        age_ns=age_ns,
        covariance=rows.upper_terms(pose.covariance),
        velocity_m_s=linear,
        angular_velocity_rad_s=angular,
        velocity_covariance=terms,
        sigma_m=position_sigma(pose.covariance),
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


def _with_nan(tree: Any) -> Any:
    """The decoded JSON with NaN where a number is null."""
    if isinstance(tree, dict):
        for key in _MAYBE_NAN:
            value = tree.get(key, 0.0)
            if isinstance(value, list):
                tree[key] = [float("nan") if item is None else item for item in value]
            elif value is None:
                tree[key] = float("nan")
    return tree


def _allow_null(rule: dict[str, Any]) -> None:
    """Change the JSON Schema of a number, or of an array of them, in place."""
    if rule.get("type") == "number":
        rule["type"] = ["number", "null"]
    for item in (rule.get("items"), *rule.get("prefixItems", ())):
        if isinstance(item, dict):
            _allow_null(item)
