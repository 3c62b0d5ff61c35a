# SPDX-License-Identifier: Apache-2.0
"""Log lines as journald likes them: its own stamps, our priority; whoever logs never waits."""

import atexit
import logging
import logging.handlers
import os
import queue
import threading
from contextlib import suppress
from typing import Any

_PRIORITIES = ((logging.ERROR, 3), (logging.WARNING, 4), (logging.INFO, 6), (logging.DEBUG, 7))
_WAITING_LINES = 1000
_LAST_WORDS_S = 1.0


class JournalFormatter(logging.Formatter):
    """Puts the priority before each line (sd-daemon(3))."""

    def format(self, record: logging.LogRecord) -> str:
        """The record's lines, each with its priority."""
        priority = next((code for level, code in _PRIORITIES if record.levelno >= level), 7)
        return "\n".join(f"<{priority}>{line}" for line in super().format(record).splitlines())


class PatientHandler(logging.handlers.QueueHandler):
    """Hands records to `handler` in a thread of its own: a pipe that nobody reads stops nobody.

    What is too much is left out and counted.
    """

    def __init__(self, handler: logging.Handler) -> None:
        self._records: queue.Queue[Any] = queue.Queue(_WAITING_LINES)
        super().__init__(self._records)
        self.dropped = 0
        self._closed = False
        self._handler = handler
        self._thread = threading.Thread(target=self._run, name="log", daemon=True)
        self._thread.start()

    def enqueue(self, record: logging.LogRecord) -> None:
        """Leave `record` for the thread, if there is room."""
        try:
            self._records.put_nowait(record)
        except queue.Full:
            self.dropped += 1

    def close(self) -> None:
        """Let the last lines out, if they go soon."""
        self._closed = True
        with suppress(queue.Full):  # then it sees by itself that this is the end
            self._records.put_nowait(None)
        self._thread.join(_LAST_WORDS_S)
        super().close()

    def _run(self) -> None:
        while (record := self._records.get()) is not None:
            self._handler.handle(record)
            if self._closed and self._records.empty():
                return


def log_for_daemon() -> None:
    """Log from INFO on; where journald reads, without what it adds by itself."""
    formatter: logging.Formatter
    if "JOURNAL_STREAM" in os.environ:
        formatter = JournalFormatter("%(name)s %(message)s")
    else:
        formatter = logging.Formatter("%(asctime)s %(levelname)s %(name)s %(message)s")
    root = logging.getLogger()
    root.setLevel(min(root.level, logging.INFO))
    for handler in list(root.handlers):
        handler.setFormatter(formatter)
        patient = PatientHandler(handler)
        root.removeHandler(handler)
        root.addHandler(patient)
        atexit.register(patient.close)
