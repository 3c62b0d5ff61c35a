# SPDX-License-Identifier: Apache-2.0
"""Writes one recording file, so that what is written stays readable whenever it breaks off."""

import os
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Literal, Self

from mcap.writer import CompressionType, Writer

from edge.capture import format as format_
from edge.capture.format import Header
from edge.store import durable
from edge.types import U8

# A kill loses the chunk under way: that of the last second, or less.
_CHUNK_BYTES = 2 * 1024 * 1024
_FLUSH_NS = 1_000_000_000

Schemas = Mapping[str, tuple[str, bytes]]  # topic: name and JSON Schema of its rows


class CaptureWriter:
    """An MCAP file that grows; OSError where it cannot, after which only `abandon` is allowed.

    Owned by one thread.
    """

    def __init__(
        self,
        path: Path,
        header: Header,
        schemas: Schemas,
        images: Literal["png", "raw"] = "png",
    ) -> None:
        self.path = path
        self._encode = format_.encode_png if images == "png" else format_.encode_raw
        self._file = path.open("xb")
        compression = CompressionType.NONE if images == "png" else CompressionType.ZSTD
        self._writer = Writer(self._file, chunk_size=_CHUNK_BYTES, compression=compression)
        self._next_flush_ns: int | None = None
        try:
            self._writer.start(profile="", library="mapvo")
            self._writer.add_metadata(format_.HEADER_NAME, header.to_metadata())
            name, text = format_.COMPRESSED_SCHEMA if images == "png" else format_.RAW_SCHEMA
            schema = self._writer.register_schema(name, "ros2msg", text.encode())
            self._channels = {
                format_.IMAGE: self._writer.register_channel(format_.IMAGE, "cdr", schema)
            }
            for topic, (title, data) in schemas.items():
                schema = self._writer.register_schema(title, "jsonschema", data)
                self._channels[topic] = self._writer.register_channel(topic, "json", schema)
            self._file.flush()
            durable.sync_folder(path.parent)  # the name; its bytes follow chunk by chunk
        except BaseException:
            self.abandon()
            path.unlink(missing_ok=True)  # it holds nothing yet
            raise

    @property
    def size_bytes(self) -> int:
        """What the file holds so far."""
        return self._file.tell()

    def add_image(self, t_ns: int, index: int, image: U8) -> None:
        """Append a grey image (h, w) uint8 taken at `t_ns`."""
        self._add(format_.IMAGE, t_ns, self._encode(t_ns, image), index)

    def add_row(self, topic: str, t_ns: int, row: bytes) -> None:
        """Append a JSON object to a topic that the schemas name."""
        self._add(topic, t_ns, row, 0)

    def flush(self) -> None:
        """Put everything on the disk, past a power cut."""
        self._writer.flush()  # type: ignore[no-untyped-call]  # the library's
        os.fdatasync(self._file.fileno())

    def finish(self) -> None:
        """Write the index and close the file."""
        self._writer.finish()  # type: ignore[no-untyped-call]  # the library's
        self._file.flush()
        os.fsync(self._file.fileno())
        self._file.close()

    def abandon(self) -> None:
        """Close the file as it is; `seal` makes it whole."""
        with suppress(
            OSError
        ):  # what is still in its buffer has no room; it is closed all the same
            self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """Close it, finished or not."""
        self.abandon()

    def _add(self, topic: str, t_ns: int, data: bytes, sequence: int) -> None:
        self._writer.add_message(
            channel_id=self._channels[topic],
            log_time=t_ns,
            publish_time=t_ns,
            data=data,
            sequence=sequence & 0xFFFFFFFF,
        )
        if self._next_flush_ns is None:
            self._next_flush_ns = t_ns + _FLUSH_NS
        elif t_ns >= self._next_flush_ns:
            self.flush()
            self._next_flush_ns = t_ns + _FLUSH_NS
