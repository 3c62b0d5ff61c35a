# SPDX-License-Identifier: Apache-2.0
"""Lets Ctrl-C and SIGTERM end things in good order."""

import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Protocol

SIGNALS = (signal.SIGINT, signal.SIGTERM)
# Signals so near to the first one say the same: `timeout` sends each twice, hands press again.
_SAME_WISH_S = 1.0


class Interruption(Protocol):
    """Whether a signal has come."""

    came: bool


class _Once:
    """Calls `stop` at the first signal; a later one has its usual effect."""

    def __init__(self, stop: Callable[[], None], clock_s: Callable[[], float]) -> None:
        self.came = False
        self._came_s = 0.0
        self._stop, self._clock_s = stop, clock_s
        self._usual = {number: signal.signal(number, self._handle) for number in SIGNALS}

    def restore(self) -> None:
        for number, handler in self._usual.items():
            signal.signal(number, handler)

    def _handle(self, number: int, _frame: FrameType | None) -> None:
        now_s = self._clock_s()
        if not self.came:
            self.came, self._came_s = True, now_s
            self._stop()
        elif now_s - self._came_s > _SAME_WISH_S:
            self.restore()
            signal.raise_signal(number)


@contextmanager
def stop_on_signal(
    stop: Callable[[], None], clock_s: Callable[[], float] = time.monotonic
) -> Iterator[Interruption]:
    """Within the block, Ctrl-C and SIGTERM call `stop` instead of breaking off anywhere.

    Nor does what comes a second time with them, in the block or after it. For the main thread only.
    """
    once = _Once(stop, clock_s)
    try:
        yield once
    finally:
        if not once.came:
            once.restore()
