# SPDX-License-Identifier: Apache-2.0
"""Makes a recording file whole that was cut off: by a kill, a power cut or a full disk.

It is done in place, as a full disk has no room for a copy: what was not written whole is cut off
behind the last good record, and the index that the end should hold is written anew.
"""

import os
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO, NamedTuple

import zstandard
from mcap.data_stream import RecordBuilder
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import (
    Channel,
    ChunkIndex,
    DataEnd,
    Footer,
    McapRecord,
    MessageIndex,
    MetadataIndex,
    Schema,
    Statistics,
)

from edge.capture.chunks import (
    MAGIC,
    RECORD_HEAD,
    Content,
    damage_as,
    parse_chunk,
    parse_content,
    read_record,
    unpack,
)
from edge.errors import OutputError, RecordingError

_FOOTER_BYTES = RECORD_HEAD.size + 20
_DAMAGE = (McapError, zstandard.ZstdError, ValueError)


class Sealed(NamedTuple):
    """What mending a file came to."""

    was_whole: bool
    messages: int
    cut_bytes: int  # behind the last good record
    bad_chunks: int  # within, left out of the index


@dataclass
class _Survey:
    """What the records from the file's start on say."""

    end: int = len(MAGIC)  # of the last good record
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    chunks: list[ChunkIndex] = field(default_factory=list)
    metadata: list[MetadataIndex] = field(default_factory=list)
    counts: Counter[int] = field(default_factory=Counter)
    bad_chunks: int = 0
    missing_indexes: list[MessageIndex] = field(default_factory=list)  # of the last chunk


def is_sealed(path: Path) -> bool:
    """Whether the file has its end."""
    with path.open("rb") as file:
        size = os.fstat(file.fileno()).st_size
        if size < len(MAGIC) + _FOOTER_BYTES:
            return False
        file.seek(size - len(MAGIC) - _FOOTER_BYTES)
        tail = file.read()
    return tail.endswith(MAGIC) and tail[0] == Opcode.FOOTER and any(tail[9:17])


def seal(path: Path) -> Sealed:
    """Make the file whole; one that is whole already stays as it is, byte for byte.

    Killed while at it, it can be called again.
    """
    with damage_as(path), path.open("rb") as file:
        if file.read(len(MAGIC)) != MAGIC:
            raise RecordingError("is no recording file (MCAP); name one that mapvo wrote")
        size = os.fstat(file.fileno()).st_size
        survey = _survey(file, size)
    messages = sum(survey.counts.values())
    if is_sealed(path):
        return Sealed(True, messages, 0, survey.bad_chunks)
    if not survey.metadata:
        raise RecordingError(f"{path}: holds nothing whole; remove it")
    try:
        with path.open("r+b") as file:
            file.truncate(survey.end)
            file.seek(survey.end)
            file.write(_ending(survey))
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        raise OutputError(
            f"{path}: cannot be mended: {error.strerror}: make room, then `mapvo recover` it"
        ) from error
    return Sealed(False, messages, size - survey.end, survey.bad_chunks)


def _survey(file: BinaryIO, size: int) -> _Survey:
    """All good records before the file's end or its first damage between records."""
    survey = _Survey()
    while survey.end + RECORD_HEAD.size <= size:
        try:
            opcode, content = read_record(file, survey.end, size)
        except ValueError:
            break
        if opcode not in _TAKEN or (opcode == Opcode.MESSAGE_INDEX and not content):
            break  # the end of the data, or zeros that a power cut left
        length = RECORD_HEAD.size + len(content)
        if opcode == Opcode.CHUNK:
            _take_chunk(survey, content, length)
        elif opcode == Opcode.METADATA:
            name_bytes = int.from_bytes(content[:4], "little")
            name = content[4 : 4 + name_bytes].decode("utf-8", "replace")
            survey.metadata.append(MetadataIndex(survey.end, length, name))
        elif opcode == Opcode.MESSAGE_INDEX:
            _take_index(survey, int.from_bytes(content[:2], "little"), length)
        survey.end += length
    return survey


_TAKEN = (Opcode.HEADER, Opcode.METADATA, Opcode.CHUNK, Opcode.MESSAGE_INDEX)


def _take_chunk(survey: _Survey, content: bytes, length: int) -> None:
    survey.missing_indexes = []
    try:
        chunk = parse_chunk(content)
        data = unpack(chunk)
        inside = parse_content(data)
    except _DAMAGE:
        survey.bad_chunks += 1
        return
    survey.schemas.update({schema.id: schema for schema in inside.schemas})
    survey.channels.update({channel.id: channel for channel in inside.channels})
    survey.counts.update(message.channel_id for _, message in inside.messages)
    survey.missing_indexes = _message_indexes(inside)
    survey.chunks.append(
        ChunkIndex(
            message_start_time=chunk.message_start_time,
            message_end_time=chunk.message_end_time,
            chunk_start_offset=survey.end,
            chunk_length=length,
            message_index_offsets={},
            message_index_length=0,
            compression=chunk.compression,
            compressed_size=len(chunk.data),
            uncompressed_size=chunk.uncompressed_size,
        )
    )


def _take_index(survey: _Survey, channel: int, length: int) -> None:
    """Note where the index of the last chunk's messages of a channel stands."""
    missing = [index for index in survey.missing_indexes if index.channel_id != channel]
    if len(missing) < len(survey.missing_indexes):
        survey.missing_indexes = missing
        survey.chunks[-1].message_index_offsets[channel] = survey.end
        survey.chunks[-1].message_index_length += length


def _message_indexes(inside: Content) -> list[MessageIndex]:
    indexes: dict[int, MessageIndex] = {}
    for offset, message in inside.messages:
        index = indexes.setdefault(message.channel_id, MessageIndex(message.channel_id, []))
        index.records.append((message.log_time, offset))
    return list(indexes.values())


def _ending(survey: _Survey) -> bytes:
    """Bytes from the end of the good records to the end of the file."""
    builder = RecordBuilder()
    for index in survey.missing_indexes:
        survey.chunks[-1].message_index_offsets[index.channel_id] = survey.end + builder.count
        index.write(builder)
    if survey.missing_indexes:
        survey.chunks[-1].message_index_length += builder.count
    DataEnd(0).write(builder)
    summary_start = survey.end + builder.count
    for record in _summary(survey):
        record.write(builder)
    Footer(summary_start=summary_start, summary_offset_start=0, summary_crc=0).write(builder)
    builder.write(MAGIC)
    ending: bytes = builder.end()  # type: ignore[no-untyped-call]  # the library's
    return ending


def _summary(survey: _Survey) -> list[McapRecord]:
    statistics = Statistics(
        attachment_count=0,
        channel_count=len(survey.channels),
        channel_message_counts=dict(survey.counts),
        chunk_count=len(survey.chunks),
        message_count=sum(survey.counts.values()),
        message_end_time=max((chunk.message_end_time for chunk in survey.chunks), default=0),
        message_start_time=min((chunk.message_start_time for chunk in survey.chunks), default=0),
        metadata_count=len(survey.metadata),
        schema_count=len(survey.schemas),
    )
    return [
        *survey.schemas.values(),
        *survey.channels.values(),
        statistics,
        *survey.chunks,
        *survey.metadata,
    ]
