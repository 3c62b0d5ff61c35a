# SPDX-License-Identifier: Apache-2.0
"""A bar with rate and time left, on a terminal only."""

import sys
import time
from collections.abc import Iterable, Iterator
from typing import TextIO, TypeVar

T = TypeVar("T")

_WIDTH = 24
_INTERVAL_S = 0.1


def progress(
    items: Iterable[T], total: int, label: str, stream: TextIO | None = None
) -> Iterator[T]:
    """Yield the items, drawing how far they are on `stream` (stderr) if it is a terminal."""
    stream = sys.stderr if stream is None else stream
    if not stream.isatty():
        yield from items
        return
    start = shown = time.monotonic()
    try:
        for done, item in enumerate(items, 1):
            yield item
            now = time.monotonic()
            if now - shown >= _INTERVAL_S or done == total:
                shown = now
                stream.write("\r" + bar(label, done, total, now - start) + "\x1b[K")
                stream.flush()
    finally:
        # The line is left to whoever writes next.
        stream.write("\r\x1b[K")
        stream.flush()


def bar(label: str, done: int, total: int, elapsed_s: float) -> str:
    """One line: label, bar, count, rate and time left."""
    part = done / max(total, 1)
    filled = "#" * int(_WIDTH * part)
    rate = done / max(elapsed_s, 1e-9)
    left_s = (total - done) / rate if rate > 0.0 else 0.0
    return (
        f"{label:<10} [{filled:<{_WIDTH}}] {done}/{total}  {rate:.1f}/s  "
        f"{int(left_s) // 60}:{int(left_s) % 60:02d} left"
    )
