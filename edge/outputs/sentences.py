# SPDX-License-Identifier: Apache-2.0
"""Poses as lines of text with a checksum, in NMEA's manner; SERIAL.md describes them."""

import math
from functools import reduce
from operator import xor

import numpy as np

from edge.geometry import so3
from edge.geometry.covariance import position_sigma, rotation_sigma
from edge.outputs.frames import BodyPose, quality_percent
from edge.outputs.serial_stream import LinkStatus


class Sentences:
    """Poses and status as sentences; one counter for both.

    Owned by one thread.
    """

    def __init__(self, *, metric: bool, level: bool) -> None:
        self._map_flags = (str(int(metric)), str(int(level)))
        self._sequence = 0

    def pose(self, body: BodyPose, quality: float, age_ns: int) -> bytes:
        """`$MVPOS` with the body's pose; an unknown number is an empty field."""
        quaternion = np.roll(so3.to_quaternion_xyzw(body.T_world_body[:3, :3]), 1)
        return sentence(
            "MVPOS",
            self._next(),
            str(body.t_ns // 1000),
            str(max(age_ns // 1000, 0)),
            *(_number(value, 4) for value in body.T_world_body[:3, 3]),
            *(_number(value, 6) for value in quaternion),
            *(_number(value, 3) for value in body.linear_m_s),
            _number(position_sigma(body.covariance), 4),
            _number(math.degrees(rotation_sigma(body.covariance)), 3),
            str(quality_percent(quality)),
            str(body.reset_counter & 0xFF),
        )

    def status(self, status: LinkStatus) -> bytes:
        """`$MVSTA` with the counts since the start, and what the map is."""
        return sentence(
            "MVSTA",
            self._next(),
            str(status.now_ns // 1000),
            str(int(status.localised)),
            status.state.value,
            str(status.frames),
            str(status.published),
            *self._map_flags,
        )

    def notice(self, _text: str) -> bytes:
        """Nothing: machines read this."""
        return b""

    def _next(self) -> str:
        sequence, self._sequence = self._sequence, (self._sequence + 1) % 100_000
        return str(sequence)


def sentence(*fields: str) -> bytes:
    """`$` fields `*` checksum CR LF; the checksum is the exclusive or of all between the two."""
    body = ",".join(fields).encode("ascii")
    return b"$%s*%02X\r\n" % (body, reduce(xor, body))


def _number(value: float, decimals: int) -> str:
    if not math.isfinite(value):
        return ""
    text = f"{value:.{decimals}f}"
    return text[1:] if float(text) == 0.0 and text[0] == "-" else text
