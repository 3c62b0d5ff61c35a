# SPDX-License-Identifier: Apache-2.0
"""Cores and priorities of threads."""

import logging
import os
import threading
from collections.abc import Sequence

log = logging.getLogger(__name__)


def settle(cpus: Sequence[int], nice: int) -> None:
    """Keep the calling thread to `cpus` (empty: any) and add `nice` to the process's own.

    What the system does not allow is left as it is and said in the log.
    """
    thread = threading.current_thread().name
    try:
        if cpus:
            os.sched_setaffinity(0, cpus)
    except OSError as error:
        log.warning("event=affinity_refused thread=%s cpus=%s: %s", thread, list(cpus), error)
    tid = threading.get_native_id()
    try:
        if nice:
            # The main thread's is what the process was started with: it settles last.
            own = os.getpriority(os.PRIO_PROCESS, os.getpid())
            os.setpriority(os.PRIO_PROCESS, tid, own + nice)
    except PermissionError as error:
        log.warning(
            "event=priority_refused thread=%s nice=%d: %s: it needs CAP_SYS_NICE or LimitNICE=",
            thread,
            nice,
            error,
        )
