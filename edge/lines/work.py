# SPDX-License-Identifier: Apache-2.0
"""How often images are searched for lines, what that finds and what it costs."""

from collections import deque
from collections.abc import Callable

from edge.types import LineSearch

Clock = Callable[[], int]  # [ns]

_KEPT = 64  # where nobody takes them


def no_clock() -> int:
    """Time stands still: searches are counted and cost nothing."""
    return 0


class LineWork:
    """Collects the searches of one stage. Owned by the thread that searches."""

    def __init__(self, clock: Clock = no_clock) -> None:
        self.clock = clock
        self._searches: deque[LineSearch] = deque(maxlen=_KEPT)

    def add(self, segments: int, began_ns: int) -> None:
        """A search that has just ended; `began_ns` by our clock."""
        self._searches.append(LineSearch(segments, (self.clock() - began_ns) * 1e-6))

    def take(self) -> tuple[LineSearch, ...]:
        """The searches since the last call."""
        taken = tuple(self._searches)
        self._searches.clear()
        return taken
