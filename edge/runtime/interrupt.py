# SPDX-License-Identifier: Apache-2.0
"""Lets Ctrl-C and SIGTERM end things in good order."""

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Protocol

SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Interruption(Protocol):
    """Whether a signal has come."""

    came: bool


class _Once:
    """Calls `stop` at the first signal; a second one has its usual effect."""

    def __init__(self, stop: Callable[[], None]) -> None:
        self.came = False
        self._stop = stop
        self._usual = {number: signal.signal(number, self._handle) for number in SIGNALS}

    def restore(self) -> None:
        for number, handler in self._usual.items():
            signal.signal(number, handler)

    def _handle(self, _number: int, _frame: FrameType | None) -> None:
        self.came = True
        self.restore()
        self._stop()


@contextmanager
def stop_on_signal(stop: Callable[[], None]) -> Iterator[Interruption]:
    """Within the block, Ctrl-C and SIGTERM call `stop` instead of breaking off anywhere.

    For the main thread only.
    """
    once = _Once(stop)
    try:
        yield once
    finally:
        if not once.came:
            once.restore()
