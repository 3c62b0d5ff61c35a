# SPDX-License-Identifier: Apache-2.0
"""Looks for changes in a process of its own, which is started anew when it fails."""

import logging
import os
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from multiprocessing.connection import Connection

from edge.runtime.change_link import Failed, Found, Order, Ready
from edge.segmenter.backoff import Backoff
from edge.segmenter.child_environment import child_environment
from edge.types import ChangeEvent, Look

log = logging.getLogger(__name__)

CHILD = (sys.executable, "-m", "edge.runtime.change_child")
_POLL_S = 0.05
_FIRST_WAIT_S, _LONGEST_WAIT_S = 1.0, 60.0
_LONGEST_SEND_S = 5.0
_LONGEST_LOOK_S = 30.0  # on a slow card, its start and a swap of memory included


class ChangeProcess:
    """The search for changes as seen from here. Owned by one thread; `reason` any may read.

    What it had seen is lost with it; nothing here raises for what happens to it.
    """

    def __init__(
        self,
        order: Order,
        child: Sequence[str] = CHILD,
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self._order, self._command, self._clock = order, child, clock
        self._backoff = Backoff(_FIRST_WAIT_S, _LONGEST_WAIT_S)
        self._due_ns = clock()
        self._process: subprocess.Popen[bytes] | None = None
        self._connection: Connection | None = None
        self.reason = ""  # why it failed last; empty where all is well
        self.restarts = 0

    @property
    def pid(self) -> int:
        """Of the process; 0 while there is none."""
        return 0 if self._process is None else self._process.pid

    def step(self, look: Look, go_on: Callable[[], bool] = lambda: True) -> list[ChangeEvent]:
        """What has become sure with this image; nothing where the process fails."""
        if self._process is None and not (self._clock() >= self._due_ns and self._start(go_on)):
            return []
        answer = self._ask(look, go_on)
        if not isinstance(answer, Found):
            return []
        self._backoff.succeed()
        self.reason = ""
        return answer.events

    def close(self) -> None:
        """End the process."""
        if self._process is not None and self._connection is not None:
            self._connection.close()
            self._process.kill()
            self._process.wait()
        self._process = self._connection = None

    def _start(self, go_on: Callable[[], bool]) -> bool:
        ours, theirs = _pipe()
        try:
            self._process = subprocess.Popen(
                [*self._command, str(theirs)],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,  # all that matters is said in answers
                pass_fds=(theirs,),
                start_new_session=True,  # Ctrl-C is ours to hear
                env=child_environment(),
            )
        except OSError as error:
            os.close(ours)
            self._fail(f"could not be started: {error.strerror or error}")
            return False
        finally:
            os.close(theirs)
        self._connection = Connection(ours)
        return isinstance(self._ask(self._order, go_on), Ready)

    def _ask(self, what: Order | Look, go_on: Callable[[], bool]) -> object:
        """The answer; None where there is none."""
        assert self._process is not None
        assert self._connection is not None
        until_ns = self._clock() + round(_LONGEST_LOOK_S * 1e9)
        try:
            self._connection.send(what)
            while not self._connection.poll(_POLL_S):
                if not go_on():
                    self.close()  # an answer that comes later would be taken for another's
                    return None
                if self._clock() > until_ns:
                    self._fail("did not answer in time")
                    return None
            answer = self._connection.recv()
        except BlockingIOError:
            self._fail("took no image in time")
            return None
        except Exception as error:  # noqa: BLE001  # what it sent may be anything
            ended = isinstance(error, (EOFError, OSError))
            self._fail("" if ended else f"answered nonsense: {type(error).__name__}")
            return None
        if isinstance(answer, Failed):
            self._fail(f"failed: {answer.reason}")
            return None
        return answer

    def _fail(self, why: str) -> None:
        status = None if self._process is None else self._process.poll()
        self.close()
        wait_s = self._backoff.fail()
        self._due_ns = self._clock() + round(wait_s * 1e9)
        self.restarts += 1
        ended = "ended" if status is None else f"ended (status {status})"
        self.reason = f"the search for changes {why or ended}"
        log.warning("event=changes_failed wait_s=%g: %s", wait_s, self.reason)


def _pipe() -> tuple[int, int]:
    """Both ends of a pipe that goes both ways."""
    import socket

    ours, theirs = socket.socketpair()
    # An image is more than a socket holds: one that reads no more must not keep us.
    wait = struct.pack("@ll", round(_LONGEST_SEND_S), 0)
    ours.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, wait)
    return ours.detach(), theirs.detach()
