# SPDX-License-Identifier: Apache-2.0
import logging
import os
import threading

import pytest

from edge.runtime.priority import settle


def in_a_thread(cpus: tuple[int, ...], nice: int) -> tuple[set[int], int]:
    """Cores and nice value of a thread that has settled."""
    found: list[tuple[set[int], int]] = []

    def work() -> None:
        settle(cpus, nice)
        tid = threading.get_native_id()
        found.append((os.sched_getaffinity(0), os.getpriority(os.PRIO_PROCESS, tid)))

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    return found[0]


def test_thread_is_settled_and_others_are_not() -> None:
    cpus, nice = os.sched_getaffinity(0), os.getpriority(os.PRIO_PROCESS, 0)
    one = min(cpus)
    assert in_a_thread((one,), 3) == ({one}, min(nice + 3, 19))
    assert in_a_thread((), 0) == (cpus, nice)
    assert os.sched_getaffinity(0) == cpus
    assert os.getpriority(os.PRIO_PROCESS, 0) == nice


def test_cores_that_are_not_there_are_said_and_left(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        cpus, _ = in_a_thread((1023,), 19)
    assert cpus == os.sched_getaffinity(0)
    assert "event=affinity_refused" in caplog.text
