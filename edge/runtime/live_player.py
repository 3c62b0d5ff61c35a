# SPDX-License-Identifier: Apache-2.0
"""Fetches a live camera's frames in a thread of its own; the tracking gets the newest."""

import logging
import time
from collections.abc import Callable
from typing import Protocol

from edge.cameras.base import Camera
from edge.errors import CameraLost, CameraRefused
from edge.runtime.mailbox import Mailbox
from edge.runtime.worker import Worker
from edge.types import Frame

log = logging.getLogger(__name__)

_RETRY_S = 1.0
_SILENT_NS = 1_000_000_000
# One is being tracked, one waits: a keyframe's hiccup of two intervals loses none.
_WAITING_FRAMES = 2


class Source(Camera, Protocol):
    """A camera that gives frames until `stop`, which any thread may call."""

    @property
    def losses(self) -> int:
        """How often it was lost."""
        ...

    def stop(self) -> None:
        """Let iterating end soon."""
        ...

    def close(self) -> None:
        """Free what is held; iterating must have ended."""
        ...


class LivePlayer:
    """Frames of a source, whatever becomes of it.

    One that was refused after it had worked (another camera in its place, another size) is
    tried again: a person puts that right without us. Owned by the tracking thread; `stop` may
    be called from any, by a signal handler too.
    """

    def __init__(self, source: Source, settle: Callable[[], None]) -> None:
        self._source = source
        self._settle = settle
        self._frames: Mailbox[Frame] = Mailbox(_WAITING_FRAMES)
        self._stopped = False
        self._refusal = ""
        self._last_ns: int | None = None
        self.keep_every = 1  # 2: every second frame is left out, and not counted as dropped
        self._worker = Worker("camera", self._fetch)

    @property
    def rate_hz(self) -> float:
        """Nominal frame rate of the source."""
        return self._source.rate_hz

    @property
    def dropped(self) -> int:
        """Frames that were lost on the way here."""
        return self._source.dropped + self._frames.dropped

    @property
    def losses(self) -> int:
        """How often the camera was lost."""
        return self._source.losses

    @property
    def ended(self) -> bool:
        """Whether no further frame will come."""
        return self._frames.closed

    def take(self, timeout_s: float) -> Frame | None:
        """The oldest frame that waits; None if none comes in time. Raises what ended the source."""
        frame = self._frames.take(timeout_s)
        if frame is None and self.ended:
            self._worker.join()  # else its failure might not be noted yet, and pass for an end
        self._worker.check()
        return frame

    def state(self, now_ns: int) -> str:
        """`starting`, `ok`, `silent`, `refused` or `ended`."""
        if self.ended:
            return "ended"
        if self._refusal:
            return "refused"
        if self._last_ns is None:
            return "starting"
        return "ok" if now_ns - self._last_ns < _SILENT_NS else "silent"

    def stop(self) -> None:
        """Let no further frame come."""
        self._stopped = True
        self._source.stop()

    def close(self) -> None:
        """Stop, end the thread and free the camera."""
        self.stop()
        self._worker.join()
        self._source.close()

    def _fetch(self) -> None:
        self._settle()
        try:
            while not self._stopped:
                try:
                    self._play()
                    return
                except CameraRefused as error:
                    if self._last_ns is None:
                        raise
                    self._say_refused(str(error))
                    self._wait()
                except CameraLost:
                    if self._last_ns is None:
                        raise
                    log.exception("event=camera_ended")
                    return
        finally:
            self._frames.close()

    def _play(self) -> None:
        for count, frame in enumerate(self._source):
            self._refusal = ""
            self._last_ns = time.monotonic_ns()
            if count % self.keep_every == 0:
                self._frames.offer(frame)

    def _say_refused(self, refusal: str) -> None:
        if refusal != self._refusal:
            log.warning("event=camera_refused %s", refusal)
        self._refusal = refusal

    def _wait(self) -> None:
        until = time.monotonic() + _RETRY_S
        while not self._stopped and time.monotonic() < until:
            time.sleep(0.05)
