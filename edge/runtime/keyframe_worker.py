# SPDX-License-Identifier: Apache-2.0
"""Runs the odometry's keyframe work: at once in replay, in a thread of its own live."""

import threading
from collections import deque
from collections.abc import Callable

from edge.odometry.keyframe_work import DelayedWorker, Job
from edge.odometry.mapper import MappedKeyframe
from edge.runtime.search import Clock
from edge.runtime.worker import Worker

# Jobs hold image buffers that the tracking uses again after six frames.
MAX_WAITING = 3


class KeyframeTimes:
    """Sums how long keyframe work took; written by its thread, read by the tracking."""

    def __init__(self, clock: Clock, *, inline: bool) -> None:
        self.inline = inline  # the work is done within the tracking's own step
        self._clock = clock
        self._spent_ns = 0
        self._read_ns = 0

    def run(self, job: Job) -> MappedKeyframe | None:
        """Result of `job`, its time added."""
        began_ns = self._clock()
        try:
            return job()
        finally:
            self._spent_ns += self._clock() - began_ns

    def take_ms(self) -> float:
        """Time since the last call."""
        spent_ns = self._spent_ns
        ms, self._read_ns = (spent_ns - self._read_ns) * 1e-6, spent_ns
        return ms


class InlineKeyframeWorker(DelayedWorker):
    """Works within the tracking's step; results take effect a fixed number of frames later."""

    def __init__(self, delay_frames: int, times: KeyframeTimes) -> None:
        super().__init__(delay_frames)
        self._times = times

    def submit(self, job: Job, *, answers: bool, may_drop: bool = False) -> None:
        """Run `job` now; only work on keyframes is timed apart."""
        timed = (lambda: self._times.run(job)) if answers else job
        super().submit(timed, answers=answers, may_drop=may_drop)


class ThreadedKeyframeWorker:
    """Works in a thread of its own, in the order of submission.

    Where it falls behind, jobs that may be dropped are left out, oldest first:
    they only sharpen depths. `settle` is called first in the thread.
    """

    def __init__(self, times: KeyframeTimes, settle: Callable[[], None] | None = None) -> None:
        self._times = times
        self._settle = settle
        self._jobs: deque[tuple[Job, bool, bool]] = deque()
        self._results: deque[MappedKeyframe | None] = deque()
        self._closed = False
        self._changed = threading.Condition()
        self._worker = Worker("keyframes", self._run)

    def submit(self, job: Job, *, answers: bool, may_drop: bool = False) -> None:
        """Queue `job`."""
        with self._changed:
            waiting = [index for index, (_, _, may) in enumerate(self._jobs) if may]
            if may_drop and len(waiting) >= MAX_WAITING:
                del self._jobs[waiting[0]]
            self._jobs.append((job, answers, may_drop))
            self._changed.notify()

    def poll(self, now: int) -> list[MappedKeyframe | None]:
        """Results that have come since the last call."""
        self._worker.check()
        ready = []
        while self._results:
            ready.append(self._results.popleft())
        return ready

    def close(self) -> None:
        """End the thread after the job under way."""
        self.abandon()
        self._worker.join()

    def abandon(self) -> None:
        """Let the thread end by itself after the job under way; nobody wants its result."""
        with self._changed:
            self._closed = True
            self._jobs.clear()
            self._changed.notify()

    def _run(self) -> None:
        if self._settle is not None:
            self._settle()
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._jobs or self._closed)
                if self._closed:
                    return
                job, answers, _ = self._jobs.popleft()
            if answers:
                self._results.append(self._times.run(job))
            else:
                job()
