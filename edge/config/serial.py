# SPDX-License-Identifier: Apache-2.0
"""The serial output: an autopilot, a microcontroller or a PLC."""

from typing import Annotated, Literal, NamedTuple

import numpy as np
from msgspec import Meta, Struct

_Row = tuple[float, float, float, float]

# A camera that looks ahead, at the body's origin. Body: x forward, y right, z down.
_LOOKS_AHEAD: tuple[_Row, _Row, _Row, _Row] = (
    (0.0, 0.0, 1.0, 0.0),
    (1.0, 0.0, 0.0, 0.0),
    (0.0, 1.0, 0.0, 0.0),
    (0.0, 0.0, 0.0, 1.0),
)
_BITS_PER_BYTE = 10  # start bit, 8 data bits, stop bit
# The share of the line that may be full: above it, one late frame makes all that follow late.
_USABLE_SHARE = 0.8
_COMMON_BAUDS = (9600, 19200, 38400, 57600, 115200, 230400, 460800, 921600, 1_500_000, 3_000_000)


class Load(NamedTuple):
    """One kind of message: its largest size on the wire, and how often it may go."""

    name: str
    size_bytes: int
    rate_hz: float


# Largest sizes on the wire [bytes]; the tests of each encoder hold them to these.
ODOMETRY_BYTES = 245
VISION_POSITION_ESTIMATE_BYTES = 129
HEARTBEAT_BYTES = 21
STATUSTEXT_BYTES = 66
BINARY_POSE_BYTES = 78
BINARY_STATUS_BYTES = 30
SENTENCE_POSE_BYTES = 200
SENTENCE_STATUS_BYTES = 80


class SerialConfig(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A serial line that poses go out on; edge/outputs/SERIAL.md describes what is sent."""

    # No device, no output. A name under /dev/serial/by-id/ stays the same after a replug.
    device: str = ""
    # What autopilots' companion ports are commonly set to; a USB device takes any.
    baud: Annotated[int, Meta(ge=1200, le=12_000_000)] = 921_600
    # `mavlink` for autopilots, `binary` for microcontrollers and PLCs, `ascii` to read by eye.
    protocol: Literal["mavlink", "binary", "ascii"] = "mavlink"
    # PX4 takes ODOMETRY with NaN where something is unknown; ArduPilot would believe the NaN,
    # so it gets VISION_POSITION_ESTIMATE.
    preset: Literal["px4", "ardupilot"] = "px4"
    # Poses a second, at most; more than the camera gives are never sent.
    rate_hz: Annotated[float, Meta(gt=0.0, le=1000.0)] = 30.0
    # The system that the camera flies on: the autopilot's own id.
    system_id: Annotated[int, Meta(ge=1, le=255)] = 1
    # MAV_COMP_ID_VISUAL_INERTIAL_ODOMETRY, what both autopilots expect a pose from.
    component_id: Annotated[int, Meta(ge=1, le=255)] = 197
    # Takes camera points (x right, y down, z forward) to the body (x forward, y right, z down) [m].
    T_body_cam: tuple[_Row, _Row, _Row, _Row] = _LOOKS_AHEAD
    # Heading of the levelled map's x axis, clockwise from true north; unknown: the frame sent is
    # called FRD, not NED, and the autopilot finds its heading itself.
    map_heading_deg: Annotated[float, Meta(ge=-360.0, le=360.0)] | None = None

    def __post_init__(self) -> None:
        if problem := _transform_problem(self.T_body_cam):
            raise ValueError(f"T_body_cam {problem}")
        if problem := _budget_problem(self):
            raise ValueError(problem)


def loads(config: SerialConfig) -> tuple[Load, ...]:
    """What the configured protocol may send, the poses first."""
    rate_hz = config.rate_hz
    if config.protocol == "binary":
        pose, status = BINARY_POSE_BYTES, BINARY_STATUS_BYTES
        return Load("pose", pose, rate_hz), Load("status", status, 1.0)
    if config.protocol == "ascii":
        pose, status = SENTENCE_POSE_BYTES, SENTENCE_STATUS_BYTES
        return Load("MVPOS", pose, rate_hz), Load("MVSTA", status, 1.0)
    if config.preset == "px4":
        poses = Load("ODOMETRY", ODOMETRY_BYTES, rate_hz)
    else:
        poses = Load("VISION_POSITION_ESTIMATE", VISION_POSITION_ESTIMATE_BYTES, rate_hz)
    return (
        poses,
        Load("HEARTBEAT", HEARTBEAT_BYTES, 1.0),
        Load("STATUSTEXT", STATUSTEXT_BYTES, 1.0),
    )


def _budget_problem(config: SerialConfig) -> str | None:
    """The sum, and what to change, where the messages do not fit the line."""
    wanted = loads(config)
    total = sum(load.size_bytes * load.rate_hz for load in wanted)
    usable = config.baud / _BITS_PER_BYTE * _USABLE_SHARE
    if total <= usable:
        return None
    terms = " + ".join(f"{x.name} {x.size_bytes} bytes x {x.rate_hz:g} Hz" for x in wanted)
    others = sum(load.size_bytes * load.rate_hz for load in wanted[1:])
    fitting_hz = int((usable - others) / wanted[0].size_bytes)
    bauds = [baud for baud in _COMMON_BAUDS if baud / _BITS_PER_BYTE * _USABLE_SHARE >= total]
    cures = [f"baud to {bauds[0]} or more"] if bauds else []
    cures += [f"rate_hz to {fitting_hz} or less"] if fitting_hz >= 1 else []
    return (
        f"a line of {config.baud} baud carries {config.baud / _BITS_PER_BYTE:.0f} bytes/s, "
        f"{_USABLE_SHARE:.0%} of it usable is {usable:.0f}, but {terms} = {total:.0f} bytes/s: "
        f"set {' or '.join(cures) or 'another baud and rate_hz'}"
    )


def _transform_problem(rows: tuple[_Row, ...]) -> str | None:
    """Why `rows` are no rigid transform, and what they should be."""
    T = np.array(rows, np.float64)
    if not np.all(np.isfinite(T)):
        return "holds a value that is no finite number"
    if not np.array_equal(T[3], [0.0, 0.0, 0.0, 1.0]):
        return "has another last row than [0, 0, 0, 1]"
    R = T[:3, :3]
    # Three decimals, as one types them, leave errors of up to a few thousandths.
    if np.abs(R @ R.T - np.eye(3)).max() > 5e-3:
        return "has columns that are not of unit length and at right angles"
    if np.linalg.det(R) < 0.0:
        return "mirrors: exchange two axes or turn one's sign"
    return None
