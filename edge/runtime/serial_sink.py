# SPDX-License-Identifier: Apache-2.0
"""Writes reports to a serial line in a thread of its own."""

import time
from collections import deque
from collections.abc import Callable

from edge.config.serial import SerialConfig
from edge.outputs.report import FrameReport
from edge.outputs.serial_port import SerialPort
from edge.outputs.serial_stream import SerialStream
from edge.runtime.mailbox import Mailbox
from edge.runtime.worker import Worker

_WAITING_NOTICES = 4
_TICK_S = 0.1  # without frames, the status and a returning device are looked after so often


class SerialSink:
    """Takes each report at once; the line gets the newest.

    Owned by the tracking thread; stream and port belong to the thread in here, which calls
    `settle` first.
    """

    def __init__(
        self,
        config: SerialConfig,
        stream: SerialStream,
        settle: Callable[[], None] | None = None,
    ) -> None:
        self._settle = settle
        self._notices: deque[str] = deque(maxlen=_WAITING_NOTICES)
        self._reports: Mailbox[FrameReport] = Mailbox()
        self._stream = stream
        self._port = SerialPort(config.device, config.baud)
        self._worker = Worker("serial", self._run)

    @property
    def sent(self) -> int:
        """How many writes the line has taken."""
        return self._port.sent

    @property
    def dropped(self) -> int:
        """How many reports or writes were overtaken, or had no line to go to."""
        return self._port.dropped + self._reports.dropped

    def write(self, report: FrameReport) -> None:
        """Leave `report` for the line; never waits for it."""
        self._worker.check()
        self._reports.offer(report)

    def tell(self, text: str) -> None:
        """Leave one line for a person, where the protocol has words; any thread may call it."""
        self._notices.append(text)

    def use(self, stream: SerialStream) -> None:
        """Write by another stream from now on: that of another map."""
        self._stream = stream

    def close(self) -> None:
        """Write what is left, if the line takes it, and free the device."""
        self._reports.close()
        self._worker.join()

    def _run(self) -> None:
        if self._settle is not None:
            self._settle()
        try:
            while True:
                report = self._reports.take(_TICK_S)
                if report is None and self._reports.closed:
                    return
                now_ns, stream = time.monotonic_ns(), self._stream
                self._port.write(stream.step(report, now_ns), now_ns)
                while self._notices:
                    self._port.write(stream.tell(self._notices.popleft()), now_ns)
        finally:
            self._port.close()
