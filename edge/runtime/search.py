# SPDX-License-Identifier: Apache-2.0
"""Runs the relocaliser beside the tracking: in its own thread live, delayed in replay."""

import logging
import math
from collections.abc import Callable
from dataclasses import replace
from typing import Protocol

import numpy as np

from edge.runtime.mailbox import Mailbox
from edge.runtime.worker import Worker
from edge.types import Fix, Query

log = logging.getLogger(__name__)

Clock = Callable[[], int]  # nanoseconds

_KEPT_FIXES = 8  # far more than can come between two frames


class RelocaliseStage(Protocol):
    """Looks for a frame in the map."""

    def step(self, query: Query) -> Fix:
        """The attempt to find `query`."""


class Search(Protocol):
    """The relocaliser as the tracking thread sees it; neither call waits."""

    def offer(self, query: Query) -> None:
        """Ask for `query`; a newer one takes its place while the relocaliser is busy."""

    def drain(self, t_ns: int) -> list[Fix]:
        """Fixes that take effect with the frame of `t_ns`; called once a frame."""

    def close(self) -> None:
        """End all work."""


class NoSearch:
    """Without a map there is nothing to search."""

    def offer(self, query: Query) -> None:
        """Take no notice."""

    def drain(self, t_ns: int) -> list[Fix]:
        """Nothing."""
        return []

    def close(self) -> None:
        """Nothing to end."""


# Stamps jitter about the periods that make up a delay.
_JITTER_S = 0.0005


class DelayedSearch:
    """Searches at once, but a fix takes effect `delay_frames` after its query was taken up.

    Where frames come seldom it is `delay_s`, as live, but no less than one frame. Until then the
    relocaliser counts as busy and the newest query waits, as with a thread; but the same run
    gives the same fixes. Owned by the tracking thread.
    """

    def __init__(
        self,
        relocaliser: RelocaliseStage,
        delay_frames: int,
        clock: Clock,
        delay_s: float = math.inf,
    ) -> None:
        self._relocaliser = relocaliser
        self._delay_frames, self._delay_s = delay_frames, delay_s
        self._clock = clock
        self._frame = self._t_ns = 0
        self._taken_up = 0, 0  # the frame and its time, of the query under way
        self._fix: Fix | None = None  # found, not yet in effect
        self._waiting: Query | None = None

    def offer(self, query: Query) -> None:
        """Take up `query`, or keep it until the fix under way is in effect."""
        if self._fix is None:
            self._fix = timed_step(self._relocaliser, query, self._clock)
            self._taken_up = self._frame, self._t_ns
        else:
            self._waiting = query

    def drain(self, t_ns: int) -> list[Fix]:
        """The fix that is due with this frame, if one is."""
        self._frame, self._t_ns = self._frame + 1, t_ns
        if self._fix is None or not self._is_due():
            return []
        fixes, self._fix = [self._fix], None
        if self._waiting is not None:
            query, self._waiting = self._waiting, None
            self.offer(query)
        return fixes

    def _is_due(self) -> bool:
        frame, t_ns = self._taken_up
        # Time falls in a reversed replay.
        waited_s = abs(self._t_ns - t_ns) * 1e-9 + _JITTER_S
        return self._frame - frame >= self._delay_frames or waited_s >= self._delay_s

    def close(self) -> None:
        """Drop what is not in effect."""
        self._fix = self._waiting = None


class ThreadedSearch:
    """The relocaliser in a thread of its own, which alone touches it.

    `settle` is called first in that thread.
    """

    def __init__(
        self,
        relocaliser: RelocaliseStage,
        clock: Clock,
        settle: Callable[[], None] | None = None,
    ) -> None:
        self._settle = settle
        self._relocaliser = relocaliser
        self._clock = clock
        self._queries: Mailbox[Query] = Mailbox()
        self._fixes: Mailbox[Fix] = Mailbox(_KEPT_FIXES)
        self._worker = Worker("relocalise", self._run)

    @property
    def dropped(self) -> int:
        """Queries that newer ones have replaced."""
        return self._queries.dropped

    def offer(self, query: Query) -> None:
        """Leave `query` for the thread."""
        self._queries.offer(query)

    def drain(self, t_ns: int) -> list[Fix]:
        """All fixes since the last call."""
        self._worker.check()
        return self._fixes.drain()

    def close(self) -> None:
        """Wait for the query under way and end the thread."""
        self._queries.close()
        self._worker.join()

    def _run(self) -> None:
        if self._settle is not None:
            self._settle()
        while (query := self._queries.take()) is not None:
            self._fixes.offer(timed_step(self._relocaliser, query, self._clock))


def timed_step(relocaliser: RelocaliseStage, query: Query, clock: Clock) -> Fix:
    """The attempt to find `query`, with its duration by `clock`."""
    began_ns = clock()
    try:
        fix = relocaliser.step(query)
    except np.linalg.LinAlgError:  # a freak image must not end what runs all day
        log.exception("event=relocalise_broke_down index=%d", query.frame.index)
        frame = query.frame
        fix = Fix(frame.index, frame.t_ns, query.odom_id, query.T_odom_cam, False, "no solution")
    return replace(fix, ms=(clock() - began_ns) * 1e-6)
