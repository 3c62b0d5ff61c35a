# SPDX-License-Identifier: Apache-2.0
"""A ring of recording files in a folder: the newest are always there, the oldest go."""

import errno
import fcntl
import logging
import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from edge.capture.format import FRAME, Header
from edge.capture.seal import is_sealed, seal
from edge.capture.writer import CaptureWriter
from edge.config.recorder import RecorderConfig
from edge.errors import EdgeError, OutputError
from edge.outputs import capture_rows
from edge.outputs.report import FrameReport
from edge.store import durable
from edge.types import Frame

log = logging.getLogger(__name__)

KEPT = "kept"  # folder beside the ring's files: what is in there never goes by itself
_MB = 1_000_000
_RETRY_NS = 5_000_000_000  # after trouble with the disk
_LEAST_FILES = 4  # however long one may be: else the oldest that goes would be nearly all
_PATTERN = "*.mcap"


def room_bytes(folder: Path) -> int:
    """Room on the folder's disk for an ordinary user."""
    figures = os.statvfs(folder)
    return figures.f_bavail * figures.f_frsize


class CaptureRing:
    """Takes frames and reports; trouble with the disk is its own, never the caller's.

    Only one process may write to a folder: OutputError says so to a second one. Files that an
    earlier process left cut off are mended first. Owned by one thread. `free_bytes` says how
    much room a folder's disk has.
    """

    def __init__(
        self,
        config: RecorderConfig,
        header: Header,
        free_bytes: Callable[[Path], int] = room_bytes,
    ) -> None:
        self.state = "recording"
        self._config = config
        self._header = header
        self._free_bytes = free_bytes
        self._folder = Path(config.folder)
        self._writer: CaptureWriter | None = None
        self._segment = 0
        self._began_ns = 0
        self._failed_ns = -_RETRY_NS
        self._images = 0
        try:
            durable.make_folder(self._folder)
            self._lock = (self._folder / ".lock").open("a")
        except OSError as error:
            raise OutputError(
                f"recorder.folder {self._folder}: {error.strerror}; name a folder that this user "
                "can write"
            ) from error
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            self._lock.close()
            raise OutputError(
                f"recorder.folder {self._folder}: another mapvo records there; name another folder"
            ) from error
        self._mend()

    def add_frame(self, frame: Frame) -> None:
        """Record a frame, with its image where its turn is."""
        takes_image = self._images % self._config.image_stride == 0
        self._images += 1

        def add(writer: CaptureWriter) -> None:
            writer.add_row(FRAME, frame.t_ns, capture_rows.frame_row(frame))
            if takes_image:
                writer.add_image(frame.t_ns, frame.index, frame.image)

        self._with_writer(frame.t_ns, add)

    def add_report(self, report: FrameReport) -> None:
        """Record what came of a frame."""

        def add(writer: CaptureWriter) -> None:
            for topic, row in capture_rows.report_rows(report):
                writer.add_row(topic, report.update.t_ns, row)

        self._with_writer(report.update.t_ns, add)

    def keep(self, reason: str) -> Path | None:
        """Put the newest two files aside, where they stay; returns their folder."""
        self._finish()
        label = "".join(c if c.isalnum() else "-" for c in reason)[:40] or "kept"
        folder = self._folder / KEPT / f"{self._header.session}-{self._segment:05d}-{label}"
        try:
            newest = self._files()[-2:]
            if not newest:
                return None
            durable.make_folder(folder)
            for path in newest:
                durable.move(path, folder / path.name)
        except OSError as error:
            log.warning("event=recording_not_kept folder=%s: %s", folder, error.strerror)
            return None
        log.info("event=recording_kept folder=%s files=%d", folder, len(newest))
        return folder

    def close(self) -> None:
        """Finish the file under way."""
        self._finish()
        self._lock.close()

    def _with_writer(self, t_ns: int, add: Callable[[CaptureWriter], None]) -> None:
        try:
            if self._writer is not None and self._is_over(self._writer, t_ns):
                self._finish()
            # Times of recordings that are played again may go back.
            if self._writer is None and abs(t_ns - self._failed_ns) >= _RETRY_NS:
                self._begin(t_ns)
            if self._writer is not None:
                add(self._writer)
        except OSError as error:
            self._give_up(t_ns, error)

    def _is_over(self, writer: CaptureWriter, t_ns: int) -> bool:
        """Whether the file under way is long or large enough."""
        is_long = not self._began_ns <= t_ns < self._began_ns + self._config.segment_s * 1e9
        return is_long or writer.size_bytes > self._config.keep_mb * _MB / _LEAST_FILES

    def _begin(self, t_ns: int) -> None:
        self._make_room()
        if self._free_bytes(self._folder) < self._config.min_free_mb * _MB:
            self._say("full", "waits for room", t_ns)
            return
        path = self._folder / f"{self._header.session}-{self._segment:05d}.mcap"
        header = replace(self._header, segment=self._segment)
        self._writer = CaptureWriter(path, header, capture_rows.schemas(), self._config.images)
        self._segment += 1
        self._began_ns = t_ns
        self._say("recording", str(path), t_ns)

    def _finish(self) -> None:
        """End the file under way, in whatever way the disk allows."""
        writer, self._writer = self._writer, None
        if writer is None:
            return
        try:
            writer.finish()
        except OSError:
            writer.abandon()
            self._seal(writer.path)

    def _give_up(self, t_ns: int, error: OSError) -> None:
        """Make whole what there is, and try again later."""
        writer, self._writer = self._writer, None
        if writer is not None:
            writer.abandon()
            self._seal(writer.path)
        full = error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
        reason = error.strerror or str(error)
        self._say("full" if full else f"failed: {reason}", reason, t_ns)

    def _say(self, state: str, detail: str, t_ns: int) -> None:
        if state != "recording":
            self._failed_ns = t_ns
        if state != self.state:
            level = logging.INFO if state == "recording" else logging.WARNING
            log.log(level, "event=recorder state=%s: %s", state.replace(" ", "_"), detail)
        self.state = state

    def _make_room(self) -> None:
        """Remove the oldest files beyond what may be kept; room for one more counts."""
        files = self._files()
        sizes = [path.lstat().st_size for path in files]
        total, limit = sum(sizes), self._config.keep_mb * _MB
        for path, size in zip(files, sizes, strict=True):
            short = self._free_bytes(self._folder) < self._config.min_free_mb * _MB
            if total + max(sizes) <= limit and not short:
                return
            path.unlink(missing_ok=True)
            total -= size

    def _files(self) -> list[Path]:
        """Oldest first; names tell the order within a session only."""
        return sorted(
            self._folder.glob(_PATTERN), key=lambda path: (path.lstat().st_mtime_ns, path.name)
        )

    def _mend(self) -> None:
        for path in self._folder.glob(_PATTERN):
            try:
                if not is_sealed(path):
                    self._seal(path)
            except OSError as error:  # one bad file must not keep the others from being recorded
                log.warning("event=recording_unmended %s: %s", path, error.strerror)

    def _seal(self, path: Path) -> None:
        try:
            seal(path)
        except EdgeError as error:
            log.warning("event=recording_unmended %s", error)
