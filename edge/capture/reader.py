# SPDX-License-Identifier: Apache-2.0
"""Reads one recording file: its header, where its images are, its rows."""

import io
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.records import ChunkIndex, MessageIndex, Metadata
from mcap.summary import Summary

from edge.capture import format as format_
from edge.capture.chunks import damage_as, message_at, read_record
from edge.capture.format import Header, header_from_metadata, image_file_bytes
from edge.capture.seal import is_sealed
from edge.errors import RecordingError

_MAX_RECORD_BYTES = 64 * 1024 * 1024
_MAX_NS = 2**63 - 1


@dataclass(frozen=True, slots=True)
class StoredImage:
    """An image within a recording file, read like a file of its own."""

    path: Path
    chunk: int  # where the chunk begins in the file
    offset: int  # where the message begins in the chunk
    number: int  # of the image, for people

    def read_bytes(self) -> bytes:
        """PNG or PGM file; RecordingError where the recording is damaged."""
        message = message_at(self.path, self.chunk, self.offset)
        with damage_as(self.path):
            return image_file_bytes(message)

    def __str__(self) -> str:
        return f"{self.path} image {self.number}"


@dataclass(frozen=True, slots=True)
class Place:
    """Where a message is."""

    t_ns: int
    chunk: int
    offset: int


class CaptureFile:
    """A whole recording file; RecordingError says what is wrong with another one."""

    def __init__(self, path: Path) -> None:
        self.path = path
        with damage_as(path), path.open("rb") as file:
            self._end = os.fstat(file.fileno()).st_size
            if not is_sealed(path):
                raise RecordingError("was cut off: mend it with `mapvo recover`")
            summary = SeekingReader(file, record_size_limit=_MAX_RECORD_BYTES).get_summary()
            if summary is None:
                raise RecordingError("has no index: mend it with `mapvo recover`")
            self.header = self._read_header(file, summary)
            self._places = self._read_places(file, summary)

    @property
    def image_places(self) -> list[Place]:
        """All images in the order of time."""
        return self._places.get(format_.IMAGE, [])

    def rows(self, topic: str) -> Iterator[tuple[int, bytes]]:
        """Times and JSON objects of a topic, in the order of time."""
        for place in self._places.get(topic, []):
            yield place.t_ns, message_at(self.path, place.chunk, place.offset)

    def _read_header(self, file: BinaryIO, summary: Summary) -> Header:
        for index in summary.metadata_indexes:
            if index.name == format_.HEADER_NAME:
                opcode, content = read_record(file, index.offset, self._end)
                if opcode == Opcode.METADATA:
                    stream = ReadDataStream(io.BytesIO(content))
                    return header_from_metadata(Metadata.read(stream).metadata)
        raise RecordingError("was not recorded by mapvo; only such files are read")

    def _read_places(self, file: BinaryIO, summary: Summary) -> dict[str, list[Place]]:
        places: dict[str, list[Place]] = {}
        for chunk in summary.chunk_indexes:
            for channel, offset in chunk.message_index_offsets.items():
                if channel in summary.channels:
                    found = self._read_index(file, chunk, offset)
                    places.setdefault(summary.channels[channel].topic, []).extend(found)
        for found in places.values():
            found.sort(key=lambda place: place.t_ns)  # stable: of one time, as they were written
        return places

    def _read_index(self, file: BinaryIO, chunk: ChunkIndex, offset: int) -> list[Place]:
        opcode, content = read_record(file, offset, self._end)
        if opcode != Opcode.MESSAGE_INDEX:
            raise ValueError("an index points to none")
        entries = MessageIndex.read(ReadDataStream(io.BytesIO(content))).records
        if any(t_ns > _MAX_NS for t_ns, _ in entries):
            raise ValueError("a time is impossible")
        return [Place(t_ns, chunk.chunk_start_offset, at) for t_ns, at in entries]
