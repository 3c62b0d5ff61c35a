# SPDX-License-Identifier: Apache-2.0
"""Records a camera, or another recording, into one file."""

import logging
import os
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Literal, NamedTuple, Protocol

from edge.cameras.base import Camera
from edge.capture.format import FRAME, Header
from edge.capture.seal import seal
from edge.capture.writer import CaptureWriter
from edge.errors import OutputError
from edge.outputs import capture_rows
from edge.outputs.capture_ring import room_bytes
from edge.runtime.interrupt import stop_on_signal
from edge.runtime.mailbox import Mailbox
from edge.runtime.worker import Worker
from edge.types import Frame

log = logging.getLogger(__name__)

_WAITING_FRAMES = 90  # 3 s at 30 Hz, for disks that stop now and then


class Limits(NamedTuple):
    """When to end by itself."""

    frames: int | None = None
    seconds: float | None = None
    min_free_mb: float = 200.0


class Recorded(NamedTuple):
    """What came of it."""

    frames: int
    dropped: int  # by the camera, or because the disk was too slow
    size_bytes: int
    full: bool  # ended because the disk has too little room left


class Source(Protocol):
    """Frames until `stop`, which any thread may call, and how many were lost on the way."""

    @property
    def dropped(self) -> int:
        """Frames lost so far."""
        ...

    def __iter__(self) -> Iterator[Frame]: ...

    def stop(self) -> None:
        """Let no further frame come."""
        ...

    def close(self) -> None:
        """End all work."""
        ...


class Played:
    """A recording as fast as it can be read; nothing is lost."""

    def __init__(self, camera: Camera) -> None:
        self._camera = camera
        self._stopped = False

    @property
    def dropped(self) -> int:
        """Frames that could not be read."""
        return self._camera.dropped

    def __iter__(self) -> Iterator[Frame]:
        for frame in self._camera:
            if self._stopped:
                return
            yield frame

    def stop(self) -> None:
        """Let no further frame come."""
        self._stopped = True

    def close(self) -> None:
        """Nothing to end."""


class Fetched:
    """A live camera, fetched in a thread of its own so that a slow disk makes it lose nothing."""

    def __init__(self, camera: Source) -> None:
        self._camera = camera
        self._frames: Mailbox[Frame] = Mailbox(_WAITING_FRAMES)
        self._worker: Worker | None = None

    @property
    def dropped(self) -> int:
        """Frames that the camera lost or the disk was too slow for."""
        return self._camera.dropped + self._frames.dropped

    def __iter__(self) -> Iterator[Frame]:
        self._worker = Worker("camera", self._fetch)
        while (frame := self._frames.take()) is not None:
            yield frame
        self._worker.join()
        self._worker.check()

    def stop(self) -> None:
        """Let no further frame come."""
        self._camera.stop()

    def close(self) -> None:
        """Stop, end the thread and free the camera."""
        self.stop()
        if self._worker is not None:
            self._worker.join()
        self._camera.close()

    def _fetch(self) -> None:
        try:
            for frame in self._camera:
                self._frames.offer(frame)
        finally:
            self._frames.close()


def record(
    source: Source,
    out: Path,
    header: Header,
    images: Literal["png", "raw"],
    limits: Limits,
) -> Recorded:
    """Write `out`; it is whole however this ends, but for a kill, after which it can be mended.

    Ctrl-C and SIGTERM end it in good order. Called in the main thread.
    """
    if os.path.lexists(out):
        raise OutputError(f"{out}: exists: name another file with --out")
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        writer = CaptureWriter(out, header, capture_rows.schemas(), images)
    except OSError as error:
        raise OutputError(
            f"{out}: cannot be written: {error.strerror}; name another place with --out"
        ) from error
    with writer, closing(source), stop_on_signal(source.stop):
        try:
            frames, full = _write_frames(source, writer, limits)
            writer.finish()
        except OSError as error:
            writer.abandon()
            sealed = seal(out)
            raise OutputError(
                f"{out}: {error.strerror or error}: {sealed.messages // 2} frames were kept; make "
                "room or name another place with --out"
            ) from error
    return Recorded(frames, source.dropped, out.stat().st_size, full)


def _write_frames(source: Source, writer: CaptureWriter, limits: Limits) -> tuple[int, bool]:
    """Frames written, and whether the disk's room ended it."""
    written = 0
    first_t_ns: int | None = None
    for frame in source:
        first_t_ns = frame.t_ns if first_t_ns is None else first_t_ns
        age_s = abs(frame.t_ns - first_t_ns) * 1e-9
        if limits.seconds is not None and age_s >= limits.seconds:
            break
        if written % 30 == 0 and room_bytes(writer.path.parent) < limits.min_free_mb * 1e6:
            return written, True
        writer.add_row(FRAME, frame.t_ns, capture_rows.frame_row(frame))
        writer.add_image(frame.t_ns, frame.index, frame.image)
        written += 1
        if written == limits.frames:
            break
    return written, False
