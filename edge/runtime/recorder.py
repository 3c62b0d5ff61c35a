# SPDX-License-Identifier: Apache-2.0
"""Records beside the tracking, in a thread of its own."""

from edge.capture.format import Header
from edge.config.recorder import RecorderConfig
from edge.outputs.capture_ring import CaptureRing
from edge.outputs.report import FrameReport
from edge.runtime.mailbox import Mailbox
from edge.runtime.worker import Worker
from edge.types import Frame

# Some 3 s at 30 Hz, an image and a report each: cards stop for that long now and then.
_WAITING_ITEMS = 180


class Recorder:
    """Takes frames and reports at once; what the disk is too slow for is lost and counted.

    Any thread may call anything but `close`; the ring belongs to the thread in here. Nothing
    that happens to the disk is raised: `state` says it.
    """

    def __init__(self, config: RecorderConfig, header: Header) -> None:
        self._ring = CaptureRing(config, header)
        self._items: Mailbox[Frame | FrameReport | str] = Mailbox(_WAITING_ITEMS)
        self._worker = Worker("recorder", self._run)

    @property
    def state(self) -> str:
        """`recording`, `full`, or `failed: ` and why."""
        try:
            self._worker.check()
        except Exception as error:  # noqa: BLE001  # whatever it was, it is this thread's end
            return f"failed: {type(error).__name__}"
        return self._ring.state

    @property
    def dropped(self) -> int:
        """Frames and reports that the disk was too slow for."""
        return self._items.dropped

    def image(self, frame: Frame) -> None:
        """Record a frame; its image must not change any more."""
        self._items.offer(frame)

    def write(self, report: FrameReport) -> None:
        """Record what came of a frame."""
        self._items.offer(report)

    def keep(self, reason: str) -> None:
        """Put the last files aside, so that they stay."""
        self._items.offer(reason)

    def close(self) -> None:
        """Write what is left and finish the file."""
        self._items.close()
        self._worker.join()

    def _run(self) -> None:
        try:
            while (item := self._items.take()) is not None:
                if isinstance(item, Frame):
                    self._ring.add_frame(item)
                elif isinstance(item, FrameReport):
                    self._ring.add_report(item)
                else:
                    self._ring.keep(item)
        finally:
            self._ring.close()
