# SPDX-License-Identifier: Apache-2.0
"""What a receiver does with binary frames; see PROTOCOL.md."""

import binascii
import struct

_CRC = struct.Struct("<I")


def unframe(data: bytes) -> bytes | None:
    """The payload of a frame, with or without its zero at the end; None where it is damaged."""
    decoded = cobs_decode(data.removesuffix(b"\0"))
    if decoded is None or len(decoded) < _CRC.size:
        return None
    payload, crc = decoded[: -_CRC.size], decoded[-_CRC.size :]
    return payload if _CRC.pack(binascii.crc32(payload)) == crc else None


def cobs_decode(data: bytes) -> bytes | None:
    """`data` with the zeros that COBS took out; None where it is no such code."""
    out = bytearray()
    place = 0
    while place < len(data):
        length = data[place]
        block = data[place + 1 : place + length]
        if length == 0 or len(block) != length - 1 or 0 in block:
            return None
        out += block
        place += length
        if length < 255 and place < len(data):
            out.append(0)
    return bytes(out)
