# SPDX-License-Identifier: Apache-2.0
"""How a process beside the daemon behaves: it ends with it, and gives way to it."""

import contextlib
import ctypes
import os
import signal
from pathlib import Path

_PR_SET_PDEATHSIG = 1
_FIRST_TO_GO = "1000"  # when the system runs out of memory: poses go on without it


def end_with_parent() -> None:
    """Be killed when the parent ends, however it does."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)


def give_way(nice: int) -> None:
    """Run at this niceness, and go first when memory is short.

    These are preferences: what the system does not allow is left.
    """
    with contextlib.suppress(OSError):  # below where it is may need a right
        os.setpriority(os.PRIO_PROCESS, 0, nice)
    with contextlib.suppress(OSError):  # inside some containers
        Path("/proc/self/oom_score_adj").write_text(_FIRST_TO_GO, encoding="ascii")
