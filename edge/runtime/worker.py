# SPDX-License-Identifier: Apache-2.0
"""A thread whose failure is not lost."""

import ctypes
import logging
import threading
from collections.abc import Callable

from edge.errors import EdgeError

log = logging.getLogger(__name__)

_PR_SET_NAME = 15


class Worker:
    """Runs `work` in a thread of its own, which ends by itself when its input is closed.

    Owned by the thread that made it.
    """

    def __init__(self, name: str, work: Callable[[], None]) -> None:
        self._failure: Exception | None = None
        # The thread lets go of `work` at its end: no cycle keeps what that holds, such as a map.
        self._thread = threading.Thread(target=self._run, args=(work,), name=name, daemon=True)
        self._thread.start()

    @property
    def is_alive(self) -> bool:
        """Whether the work is still going on."""
        return self._thread.is_alive()

    def check(self) -> None:
        """Raise here what ended the thread there, if anything did."""
        if self._failure is not None:
            raise self._failure

    def join(self) -> None:
        """Wait for the thread's end."""
        self._thread.join()

    def _run(self, work: Callable[[], None]) -> None:
        name_thread(self._thread.name)
        try:
            work()
        except EdgeError as error:
            self._failure = error
        except Exception as error:  # the thread's top: told to the owner
            log.exception("event=thread_died name=%s", self._thread.name)
            self._failure = error


def name_thread(name: str) -> None:
    """Let `top -H` and debuggers call this thread by its name, of which Linux keeps 15 letters."""
    prctl = getattr(ctypes.CDLL(None), "prctl", None)
    if prctl is not None:
        prctl(_PR_SET_NAME, name.encode()[:15], 0, 0, 0)
