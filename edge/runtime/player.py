# SPDX-License-Identifier: Apache-2.0
"""Plays a camera's frames: as fast as they are taken, or at their own times."""

import time
from collections.abc import Iterator
from typing import NamedTuple, Protocol

from edge.cameras.base import Camera
from edge.runtime.mailbox import Mailbox
from edge.runtime.worker import Worker
from edge.types import Frame


class Arrival(NamedTuple):
    """A frame as it reaches the tracking thread."""

    frame: Frame
    captured_ns: int | None  # monotonic clock; None where there is no real time
    decode_ms: float


class Player(Protocol):
    """Gives arrivals until the camera ends."""

    @property
    def dropped(self) -> int:
        """Frames that never arrived: unreadable, or overtaken by newer ones."""

    def __iter__(self) -> Iterator[Arrival]:
        """Each arrival once."""

    def stop(self) -> None:
        """Let no further frame come; a signal handler may call it."""

    def close(self) -> None:
        """End all work."""


class OfflinePlayer:
    """Decodes each frame when it is asked for, in the thread that asks."""

    def __init__(self, camera: Camera) -> None:
        self._camera = camera
        self._stopped = False

    @property
    def dropped(self) -> int:
        """Frames that could not be read."""
        return self._camera.dropped

    def __iter__(self) -> Iterator[Arrival]:
        """Frames with their decoding time on this thread's CPU."""
        frames = iter(self._camera)
        while not self._stopped:
            began_ns = time.thread_time_ns()
            frame = next(frames, None)
            decode_ms = (time.thread_time_ns() - began_ns) * 1e-6
            if frame is None:
                return
            yield Arrival(frame, None, decode_ms)

    def stop(self) -> None:
        """Let no further frame come."""
        self._stopped = True

    def close(self) -> None:
        """Nothing to end."""


class RealTimePlayer:
    """Decodes in a thread of its own and hands each frame over when it is due.

    Who is late gets the newest frame only, as from a live camera. A recording
    played backwards keeps its intervals.
    """

    def __init__(self, camera: Camera) -> None:
        self._camera = camera
        self._arrivals: Mailbox[Arrival] = Mailbox()
        self._stopped = False
        self._worker: Worker | None = None

    @property
    def dropped(self) -> int:
        """Frames that could not be read or were overtaken."""
        return self._camera.dropped + self._arrivals.dropped

    def __iter__(self) -> Iterator[Arrival]:
        """Frames as they come; the clock starts with the first call."""
        self._worker = Worker("camera", self._play)
        while (arrival := self._arrivals.take()) is not None:
            yield arrival
        self._worker.join()
        self._worker.check()

    def stop(self) -> None:
        """Let no further frame come, not even the one that is waited for."""
        self._stopped = True

    def close(self) -> None:
        """Stop and end the thread."""
        self.stop()
        if self._worker is not None:
            self._worker.join()

    def _play(self) -> None:
        try:
            frames = iter(self._camera)
            start_ns = first_t_ns = None
            while not self._stopped:
                began_ns = time.monotonic_ns()
                if (frame := next(frames, None)) is None:
                    return
                now_ns = time.monotonic_ns()
                if start_ns is None or first_t_ns is None:
                    start_ns, first_t_ns = now_ns, frame.t_ns
                due_ns = start_ns + abs(frame.t_ns - first_t_ns)
                if not self._reached(due_ns):
                    return
                self._arrivals.offer(Arrival(frame, due_ns, (now_ns - began_ns) * 1e-6))
        finally:
            self._arrivals.close()

    def _reached(self, due_ns: int) -> bool:
        """Sleep until then, in short pieces so that `stop` is heard in a gap of the recording."""
        while not self._stopped and (left_ns := due_ns - time.monotonic_ns()) > 0:
            time.sleep(min(left_ns * 1e-9, 0.1))
        return not self._stopped
