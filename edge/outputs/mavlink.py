# SPDX-License-Identifier: Apache-2.0
"""MAVLink 2 messages to bytes, as the common dialect defines them.

Only what an external pose estimator sends; sizes and orders of fields are those
on the wire (largest type first, extension fields last).
"""

import binascii
import struct
from dataclasses import dataclass

from edge.types import F64

FRAME_LOCAL_FRD = 20  # level, its heading arbitrary
FRAME_LOCAL_NED = 1
FRAME_BODY_FRD = 12
STATE_STANDBY, STATE_ACTIVE = 3, 4
SEVERITY_WARNING, SEVERITY_NOTICE, SEVERITY_INFO = 4, 5, 6

_MAGIC = 0xFD
_TYPE_ONBOARD_CONTROLLER = 18
_AUTOPILOT_INVALID = 8  # this component is none
_PROTOCOL_VERSION = 3
_ESTIMATOR_VISION = 2
_TEXT_BYTES = 50

_HEADER = struct.Struct("<BBBBBBBHB")
_HEARTBEAT = struct.Struct("<IBBBBB")
_ODOMETRY = struct.Struct("<Q3f4f3f3f21f21fBBBBb")
_VISION_POSITION_ESTIMATE = struct.Struct("<Q3f3f21fB")
_STATUSTEXT = struct.Struct(f"<B{_TEXT_BYTES}sHB")
_REVERSED_BITS = bytes(int(f"{byte:08b}"[::-1], 2) for byte in range(256))


@dataclass(frozen=True, slots=True, eq=False)
class Odometry:
    """Fields of ODOMETRY; the rotation is w x y z, covariances are upper triangles, row by row."""

    t_us: int
    frame_id: int
    position_m: F64  # (3,)
    quaternion_wxyz: F64  # (4,)
    linear_m_s: F64  # (3,) in body axes
    angular_rad_s: F64  # (3,) in body axes
    pose_covariance: F64  # (21,)
    velocity_covariance: F64  # (21,)
    reset_counter: int  # modulo 256
    quality_percent: int


@dataclass(frozen=True, slots=True, eq=False)
class VisionPositionEstimate:
    """Fields of VISION_POSITION_ESTIMATE."""

    t_us: int
    position_m: F64  # (3,)
    roll_pitch_yaw_rad: F64  # (3,)
    covariance: F64  # (21,)
    reset_counter: int  # modulo 256


def checksum(data: bytes) -> int:
    """CRC-16/MCRF4XX of `data`, which MAVLink calls X.25.

    The standard library has the same polynomial with the bits of each byte the other way round.
    """
    reflected = binascii.crc_hqx(data.translate(_REVERSED_BITS), 0xFFFF)
    return int(f"{reflected:016b}"[::-1], 2)


class Encoder:
    """Frames messages of one component and counts them.

    Owned by one thread.
    """

    def __init__(self, system_id: int, component_id: int) -> None:
        self._system_id = system_id
        self._component_id = component_id
        self._sequence = 0

    def heartbeat(self, system_status: int) -> bytes:
        """HEARTBEAT of an onboard computer."""
        payload = _HEARTBEAT.pack(
            0, _TYPE_ONBOARD_CONTROLLER, _AUTOPILOT_INVALID, 0, system_status, _PROTOCOL_VERSION
        )
        return self._frame(0, 50, payload)

    def odometry(self, message: Odometry) -> bytes:
        """ODOMETRY, its velocities in the body's frame."""
        payload = _ODOMETRY.pack(
            message.t_us,
            *message.position_m,
            *message.quaternion_wxyz,
            *message.linear_m_s,
            *message.angular_rad_s,
            *message.pose_covariance,
            *message.velocity_covariance,
            message.frame_id,
            FRAME_BODY_FRD,
            message.reset_counter,
            _ESTIMATOR_VISION,
            message.quality_percent,
        )
        return self._frame(331, 91, payload)

    def vision_position_estimate(self, message: VisionPositionEstimate) -> bytes:
        """VISION_POSITION_ESTIMATE."""
        payload = _VISION_POSITION_ESTIMATE.pack(
            message.t_us,
            *message.position_m,
            *message.roll_pitch_yaw_rad,
            *message.covariance,
            message.reset_counter,
        )
        return self._frame(102, 158, payload)

    def statustext(self, severity: int, text: str) -> bytes:
        """STATUSTEXT of at most 50 characters; what is longer is cut."""
        return self._frame(
            253, 83, _STATUSTEXT.pack(severity, text.encode("ascii", "replace"), 0, 0)
        )

    def _frame(self, message_id: int, crc_extra: int, payload: bytes) -> bytes:
        """Header, payload without its trailing zeros (one byte stays), checksum."""
        payload = payload.rstrip(b"\0") or b"\0"
        header = _HEADER.pack(
            _MAGIC,
            len(payload),
            0,
            0,
            self._sequence,
            self._system_id,
            self._component_id,
            message_id & 0xFFFF,
            message_id >> 16,
        )
        self._sequence = (self._sequence + 1) & 0xFF
        # The extra byte is a hash of the message's definition: a peer with another one refuses it.
        crc = checksum(header[1:] + payload + bytes((crc_extra,)))
        return header + payload + struct.pack("<H", crc)
