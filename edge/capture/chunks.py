# SPDX-License-Identifier: Apache-2.0
"""Chunks of a recording file: read whole, checked, never larger than they may be."""

import functools
import io
import os
import struct
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO, NamedTuple

import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Message, Schema

from edge.errors import RecordingError

MAGIC = b"\x89MCAP0\r\n"
RECORD_HEAD = struct.Struct("<BQ")  # opcode, length of what follows
# Ours hold some 2 MB; what is far larger is damage or bad will.
MAX_CHUNK_BYTES = 256 * 1024 * 1024
_KEPT_CHUNKS = 2  # the one that is played and, at a seam, the one before


class Content(NamedTuple):
    """What a chunk holds, in its order; offsets are those within the unpacked chunk."""

    schemas: list[Schema]
    channels: list[Channel]
    messages: list[tuple[int, Message]]


@contextmanager
def damage_as(path: Path) -> Iterator[None]:
    """Let whatever a damaged file makes its readers raise be a RecordingError."""
    try:
        yield
    except RecordingError as error:
        if str(error).startswith(str(path)):
            raise
        raise RecordingError(f"{path}: {error}") from None
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {error.strerror or error}") from None
    except (
        *(McapError, zstandard.ZstdError, struct.error, UnicodeDecodeError),
        *(ValueError, OverflowError, KeyError, MemoryError, StopIteration),
    ) as error:
        raise RecordingError(
            f"{path}: is damaged ({type(error).__name__}): mend it with `mapvo recover`"
        ) from error


def read_record(file: BinaryIO, offset: int, end: int) -> tuple[int, bytes]:
    """Opcode and content of the record at `offset`; ValueError where it would end after `end`."""
    file.seek(offset)
    opcode, length = RECORD_HEAD.unpack(file.read(RECORD_HEAD.size))
    if length > end - offset - RECORD_HEAD.size:
        raise ValueError("a record is longer than the file")
    return opcode, file.read(length)


def parse_chunk(content: bytes) -> Chunk:
    """Chunk of a record's content; ValueError where its parts do not add up."""
    chunk: Chunk = Chunk.read(ReadDataStream(io.BytesIO(content)))
    # Two strings and six numbers stand before the data.
    if len(chunk.data) != len(content) - 40 - len(chunk.compression):
        raise ValueError("a chunk is cut short")
    return chunk


def unpack(chunk: Chunk) -> bytes:
    """Bytes of a chunk; ValueError or ZstdError where they are not those that were written."""
    if chunk.uncompressed_size > MAX_CHUNK_BYTES:
        raise ValueError("a chunk is too large")
    if chunk.compression == "zstd":
        if zstandard.frame_content_size(chunk.data) != chunk.uncompressed_size:
            raise ValueError("a chunk's size is wrong")
        data = zstandard.ZstdDecompressor().decompress(chunk.data)
    elif chunk.compression == "":
        data = chunk.data
    else:
        raise ValueError(f"compression {chunk.compression} is not read")
    if len(data) != chunk.uncompressed_size or zlib.crc32(data) != chunk.uncompressed_crc:
        raise ValueError("a chunk's checksum is wrong")
    return data


def parse_content(data: bytes) -> Content:
    """Records of an unpacked chunk."""
    content = Content([], [], [])
    offset = 0
    while offset < len(data):
        opcode, length = RECORD_HEAD.unpack_from(data, offset)
        begin = offset + RECORD_HEAD.size
        if length > len(data) - begin:
            raise ValueError("a record is longer than its chunk")
        stream = ReadDataStream(io.BytesIO(data[begin : begin + length]))
        if opcode == Opcode.SCHEMA:
            content.schemas.append(Schema.read(stream))
        elif opcode == Opcode.CHANNEL:
            content.channels.append(Channel.read(stream))
        elif opcode == Opcode.MESSAGE:
            content.messages.append((offset, Message.read(stream, length)))
        offset = begin + length
    return content


def message_at(path: Path, chunk_offset: int, offset: int) -> bytes:
    """Data of the message at `offset` within the chunk at `chunk_offset` of a file."""
    with damage_as(path):
        status = path.stat()
        stamp = (status.st_ino, status.st_size, status.st_mtime_ns)  # it may have been replaced
        data: bytes = _unpacked(path, chunk_offset, stamp)
        if not 0 <= offset <= len(data) - RECORD_HEAD.size:
            raise ValueError("an index points outside of its chunk")
        opcode, length = RECORD_HEAD.unpack_from(data, offset)
        begin = offset + RECORD_HEAD.size
        if opcode != Opcode.MESSAGE or length > len(data) - begin:
            raise ValueError("an index points to no message")
        stream = ReadDataStream(io.BytesIO(data[begin : begin + length]))
        message: Message = Message.read(stream, length)
        return message.data


@functools.lru_cache(maxsize=_KEPT_CHUNKS)
def _unpacked(path: Path, offset: int, _stamp: tuple[int, int, int]) -> bytes:
    with path.open("rb") as file:
        end = os.fstat(file.fileno()).st_size
        opcode, content = read_record(file, offset, end)
    if opcode != Opcode.CHUNK:
        raise ValueError("an index points to no chunk")
    return unpack(parse_chunk(content))
