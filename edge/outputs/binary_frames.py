# SPDX-License-Identifier: Apache-2.0
"""Small frames for microcontrollers and PLCs: COBS with a CRC-32; SERIAL.md describes them."""

import binascii
import math
import struct

import numpy as np

from edge.geometry import so3
from edge.geometry.covariance import largest_sigma, position_sigma, rotation_sigma
from edge.outputs.frames import BodyPose, quality_percent
from edge.outputs.serial_stream import LinkStatus
from edge.types import OdometryState

VERSION = 1
POSE, STATUS = 1, 2
LOCALISED, METRIC, LEVEL = 1, 2, 4
STATES = {
    OdometryState.WAITING: 0,
    OdometryState.INITIALISING: 1,
    OdometryState.TRACKING: 2,
    OdometryState.LOST: 3,
}
# type, version, sequence, flags, reset counter, quality, reserved, t_us, age_us,
# position, quaternion wxyz, velocity in body axes, three sigmas
POSE_LAYOUT = struct.Struct("<BBHBBBBQI3f4f3f3f")
# type, version, sequence, flags, state, reserved, now_us, frames, published
STATUS_LAYOUT = struct.Struct("<BBHBBHQII")
_CRC = struct.Struct("<I")


class BinaryFrames:
    """Poses and status as frames; one counter for both.

    Owned by one thread.
    """

    def __init__(self, *, metric: bool, level: bool) -> None:
        self._flags = METRIC * metric | LEVEL * level
        self._sequence = 0

    def pose(self, body: BodyPose, quality: float, age_ns: int) -> bytes:
        """One frame with the body's pose."""
        sigma = _worst_sigmas(body)
        payload = POSE_LAYOUT.pack(
            POSE,
            VERSION,
            self._next(),
            self._flags | LOCALISED,
            body.reset_counter & 0xFF,
            quality_percent(quality),
            0,
            body.t_ns // 1000,
            min(max(age_ns // 1000, 0), 0xFFFFFFFF),
            *body.T_world_body[:3, 3],
            *np.roll(so3.to_quaternion_xyzw(body.T_world_body[:3, :3]), 1),
            *body.linear_m_s,
            *sigma,
        )
        return frame(payload)

    def status(self, status: LinkStatus) -> bytes:
        """One frame with the counts since the start."""
        payload = STATUS_LAYOUT.pack(
            STATUS,
            VERSION,
            self._next(),
            self._flags | LOCALISED * status.localised,
            STATES[status.state],
            0,
            status.now_ns // 1000,
            status.frames & 0xFFFFFFFF,
            status.published & 0xFFFFFFFF,
        )
        return frame(payload)

    def notice(self, _text: str) -> bytes:
        """Nothing: machines read this."""
        return b""

    def _next(self) -> int:
        sequence, self._sequence = self._sequence, (self._sequence + 1) & 0xFFFF
        return sequence


def frame(payload: bytes) -> bytes:
    """`payload` and its CRC-32 without zeros in them (COBS), ended by a zero."""
    return cobs_encode(payload + _CRC.pack(binascii.crc32(payload))) + b"\0"


def cobs_encode(data: bytes) -> bytes:
    """`data` without zeros: each run up to a zero follows a byte that holds its length plus one."""
    out = bytearray()
    runs = data.split(b"\0")
    for number, run in enumerate(runs):
        while len(run) >= 254:  # a full block stands for no zero
            out += b"\xff" + run[:254]
            run = run[254:]
            if not run and number == len(runs) - 1:
                return bytes(out)
        out += bytes((len(run) + 1,)) + run
    return bytes(out)


def _worst_sigmas(body: BodyPose) -> tuple[float, ...]:
    """Standard deviations along the worst direction: position, rotation, velocity; NaN: unknown."""
    velocity = largest_sigma(body.velocity_covariance[:3, :3])
    sigmas = (position_sigma(body.covariance), rotation_sigma(body.covariance), velocity)
    return tuple(sigma if math.isfinite(sigma) else math.nan for sigma in sigmas)
