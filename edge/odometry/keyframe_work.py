# SPDX-License-Identifier: Apache-2.0
"""Where keyframe work runs: in replay at once, its results held back; live elsewhere."""

from collections import deque
from collections.abc import Callable
from typing import Protocol

from edge.odometry.mapper import MappedKeyframe

Job = Callable[[], "MappedKeyframe | None"]


class KeyframeWorker(Protocol):
    """Runs jobs in order, elsewhere or later."""

    def submit(self, job: Job, *, answers: bool, may_drop: bool = False) -> None:
        """Queue a job; only one that answers gives a result to poll.

        What `may_drop` is left out where there is no time for it.
        """

    def poll(self, now: int) -> "list[MappedKeyframe | None]":
        """Results that are there at step `now`, a counter of frames."""


class DelayedWorker:
    """Runs jobs at once and hands out their results `delay` frames later: replay."""

    def __init__(self, delay: int) -> None:
        self._delay, self._now = delay, 0
        self._done: deque[tuple[int, MappedKeyframe | None]] = deque()

    def submit(self, job: Job, *, answers: bool, may_drop: bool = False) -> None:
        """Run `job` now."""
        result = job()
        if answers:
            self._done.append((self._now + self._delay, result))

    def poll(self, now: int) -> list[MappedKeyframe | None]:
        """Results whose time has come."""
        self._now = now
        ready = []
        while self._done and self._done[0][0] <= now:
            ready.append(self._done.popleft()[1])
        return ready
