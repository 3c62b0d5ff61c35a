# SPDX-License-Identifier: Apache-2.0
"""The user's model as others see it: images go in, detections come out, and it never does harm."""

import contextlib
import logging
import os
import select
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Literal, NamedTuple, TypeAlias

import msgspec

from edge.config.segmenter import SegmenterConfig
from edge.segmenter.backoff import Backoff
from edge.segmenter.child_environment import child_environment
from edge.segmenter.contract import Contract
from edge.segmenter.link import (
    MARK,
    Answer,
    Failed,
    ImageMemory,
    Order,
    Ready,
    Receiver,
    Refused,
    Seen,
    make_memory,
    unpack,
)
from edge.types import U8, Detections

log = logging.getLogger(__name__)

State: TypeAlias = Literal["starting", "ready", "busy", "waiting", "refused", "closed"]
CHILD = (sys.executable, "-m", "edge.segmenter.child")


class SegmenterStatus(NamedTuple):
    """How the model fares."""

    state: State
    reason: str  # why the last image or process failed; empty where all is well
    images: int
    failed: int  # images of which nothing came
    restarts: int
    ms: float  # processor time of the last image
    rss_mb: float  # of its process
    pid: int  # of its process; 0 while there is none


class Segmentation(NamedTuple):
    """What the model saw in the image that was offered with `mark`."""

    mark: int
    detections: Detections


class _Child:
    """One run of the model's process, and our ends of its pipes."""

    def __init__(self, command: Sequence[str], order: Order) -> None:
        self.answers_fd, write_fd = os.pipe2(os.O_CLOEXEC)
        order = msgspec.structs.replace(order, answers_fd=write_fd)
        try:
            self.process = subprocess.Popen(
                [*command, msgspec.json.encode(order).decode()],
                stdin=subprocess.PIPE,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,  # all that matters is said in answers
                pass_fds=(order.memory_fd, write_fd),
                start_new_session=True,  # Ctrl-C is ours to hear
                env=child_environment(),
                bufsize=0,
            )
        except BaseException:
            os.close(self.answers_fd)
            raise
        finally:
            os.close(write_fd)
        self.receiver = Receiver(self.answers_fd)

    def order(self, mark: int) -> None:
        """Ask for the image that lies in the memory."""
        assert self.process.stdin is not None
        with contextlib.suppress(BrokenPipeError):  # its end is noticed where answers are read
            self.process.stdin.write(MARK.pack(mark))

    def end(self) -> int:
        """Kill it: it holds nothing that would be lost. Returns its status."""
        self.process.kill()
        status = self.process.wait()
        if self.process.stdin is not None:
            self.process.stdin.close()
        os.close(self.answers_fd)
        return status


class SegmenterProcess:
    """Runs a model in a child process and starts it anew when it fails.

    Takes one image at a time: `offer` says whether it was taken. `poll` gives results and does all
    that has to be done in time. Owned by one thread; nothing here raises for what a model does.
    """

    def __init__(
        self,
        model: Path,
        shape: tuple[int, ...],
        config: SegmenterConfig,
        child: Sequence[str] = CHILD,
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        """Start it, for images of `shape`: (h, w) grey or (h, w, 3) red first."""
        self._command, self._clock, self._config = child, clock, config
        self._memory_fd = make_memory()
        self._memory = ImageMemory(self._memory_fd, shape)
        self._order = Order(str(model), config, shape, self._memory_fd, -1)
        self._backoff = Backoff(config.first_wait_s, config.longest_wait_s)
        self.contract: Contract | None = None
        self._status = SegmenterStatus("starting", "", 0, 0, 0, 0.0, 0.0, 0)
        self._mark = 0
        self._child: _Child | None = None
        self._due_ns = 0  # of an answer, or of the next start
        self._start()

    @property
    def status(self) -> SegmenterStatus:
        """How it fares."""
        return self._status

    def offer(self, mark: int, image: U8) -> bool:
        """Hand over an image; False while the model cannot take one. The image is copied."""
        if self._status.state != "ready" or self._child is None:
            return False
        self._memory.image[:] = image
        self._mark = mark
        self._due_ns = self._clock() + round(self._config.image_timeout_s * 1e9)
        self._set(state="busy")
        self._child.order(mark)
        return True

    def poll(self, timeout_s: float = 0.0) -> Segmentation | None:
        """A result, if there is one within the time; restarts what has failed when it is due."""
        if self._status.state in ("refused", "closed"):
            return None
        if self._child is None:
            if self._clock() >= self._due_ns:
                self._start()
            return None
        if select.select([self._child.answers_fd], [], [], timeout_s)[0]:
            return self._receive(self._child)
        if self._status.state != "ready" and self._clock() > self._due_ns:
            what = "start" if self._status.state == "starting" else "answer"
            self._fail(f"did not {what} in time")
        return None

    def close(self) -> None:
        """End the process and free its memory."""
        if self._status.state == "closed":
            return
        self._set(state="closed")
        if self._child is not None:
            self._end_child()
        self._memory.close()
        os.close(self._memory_fd)

    def _start(self) -> None:
        self._set(state="starting")
        self._due_ns = self._clock() + round(self._config.start_timeout_s * 1e9)
        try:
            self._child = _Child(self._command, self._order)
        except OSError as error:
            self._fail(f"could not be started: {error.strerror or error}")
            return
        self._set(pid=self._child.process.pid)

    def _receive(self, child: _Child) -> Segmentation | None:
        try:
            received = child.receiver.receive()
            for answer in received.answers:
                if (result := self._take(answer)) is not None:
                    return result  # one image at a time: nothing stands behind it
        except ValueError as error:
            self._fail(str(error))
            return None
        if received.ended and self._child is not None:
            self._fail("")
        return None

    def _take(self, answer: Answer) -> Segmentation | None:
        if isinstance(answer, Ready):
            self.contract = answer.contract
            log.info("event=segmenter_ready convention=%s", answer.contract.output.convention)
            self._set(state="ready")
        elif isinstance(answer, Refused):
            log.info("event=segmenter_refused: %s", answer.reason)
            self._end_child()
            self._set(state="refused", reason=answer.reason)
        elif answer.mark != self._mark or self._status.state != "busy":
            raise ValueError("its process answers what it was not asked")
        elif isinstance(answer, Failed):
            if answer.reason != self._status.reason:  # said once, not for each image
                log.info("event=segmenter_failed: %s", answer.reason)
            failed = self._status.failed + 1
            self._set(state="ready", reason=answer.reason, failed=failed)
        else:
            return self._accept(answer)
        return None

    def _accept(self, seen: Seen) -> Segmentation:
        detections = unpack(seen, self._order.shape)
        self._backoff.succeed()
        self._set(
            state="ready", reason="", images=self._status.images + 1, ms=seen.ms, rss_mb=seen.rss_mb
        )
        return Segmentation(seen.mark, detections)

    def _fail(self, why: str) -> None:
        """End this run; the next one starts after a while."""
        was_busy = self._status.state == "busy"
        status = self._end_child()
        reason = f"its process {why or _explain(status)}"
        wait_s = self._backoff.fail()
        self._due_ns = self._clock() + round(wait_s * 1e9)
        log.info("event=segmenter_ended wait_s=%g: %s", wait_s, reason)
        self._set(
            state="waiting",
            reason=reason,
            restarts=self._status.restarts + 1,
            failed=self._status.failed + was_busy,
        )

    def _end_child(self) -> int:
        child, self._child = self._child, None
        self._set(pid=0)
        return child.end() if child is not None else 0

    def _set(self, **changes: object) -> None:
        self._status = self._status._replace(**changes)  # type: ignore[arg-type]


def _explain(status: int) -> str:
    return f"was ended by signal {-status}" if status < 0 else f"ended (status {status})"
