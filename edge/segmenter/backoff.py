# SPDX-License-Identifier: Apache-2.0
"""How long to wait before something that failed is tried again."""

_SETTLED = 10  # successes in a row after which the past is forgotten


class Backoff:
    """Doubles the wait with each failure, up to a longest one."""

    def __init__(self, first_s: float, longest_s: float) -> None:
        self._first_s, self._longest_s = first_s, longest_s
        self._next_s = first_s
        self._good = 0

    def fail(self) -> float:
        """Seconds to wait after this failure."""
        wait_s = min(self._next_s, self._longest_s)
        self._next_s = min(2.0 * self._next_s, self._longest_s)
        self._good = 0
        return wait_s

    def succeed(self) -> None:
        """Note that it worked; only after some times is the next wait short again."""
        self._good += 1
        if self._good == _SETTLED:
            self._next_s = self._first_s
