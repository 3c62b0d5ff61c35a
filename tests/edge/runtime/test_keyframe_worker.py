# SPDX-License-Identifier: Apache-2.0
import threading
import time
from functools import partial

import pytest

from edge.runtime.keyframe_worker import (
    MAX_WAITING,
    InlineKeyframeWorker,
    KeyframeTimes,
    ThreadedKeyframeWorker,
)

PATIENCE_S = 60.0


def times(*, inline: bool) -> KeyframeTimes:
    return KeyframeTimes(time.monotonic_ns, inline=inline)


def poll_for_ever(worker: ThreadedKeyframeWorker) -> None:
    while True:
        worker.poll(0)
        time.sleep(0.001)


def sleeping_job() -> None:
    time.sleep(0.01)


def test_only_keyframe_work_is_timed() -> None:
    spent = times(inline=True)
    worker = InlineKeyframeWorker(1, spent)
    worker.submit(sleeping_job, answers=False)
    assert spent.take_ms() == 0.0
    worker.submit(sleeping_job, answers=True)
    assert spent.take_ms() >= 10.0
    assert spent.take_ms() == 0.0


def test_inline_result_comes_so_many_frames_later() -> None:
    worker = InlineKeyframeWorker(2, times(inline=True))
    assert worker.poll(10) == []
    worker.submit(sleeping_job, answers=True)
    assert worker.poll(11) == []
    assert worker.poll(12) == [None]


def test_thread_works_in_order_and_answers() -> None:
    worker = ThreadedKeyframeWorker(times(inline=False))
    done: list[int] = []
    worker.submit(lambda: done.append(1), answers=False)
    worker.submit(lambda: done.append(2), answers=True)
    while not (answers := worker.poll(0)):
        time.sleep(0.001)
    worker.close()
    assert answers == [None]
    assert done == [1, 2]


def test_late_thread_leaves_out_what_may_be_dropped_and_nothing_else() -> None:
    worker = ThreadedKeyframeWorker(times(inline=False))
    begun, gate, ended = threading.Event(), threading.Event(), threading.Event()
    done: list[str] = []

    def wait_at_gate() -> None:
        begun.set()
        gate.wait(PATIENCE_S)

    worker.submit(wait_at_gate, answers=False)
    assert begun.wait(PATIENCE_S)
    worker.submit(lambda: done.append("keyframe"), answers=True)
    worker.submit(lambda: done.append("masks"), answers=False)
    for index in range(20):
        job = partial(done.append, str(index))
        worker.submit(job, answers=False, may_drop=True)
    worker.submit(ended.set, answers=True)
    gate.set()
    assert ended.wait(PATIENCE_S)
    worker.close()
    assert done == ["keyframe", "masks", *map(str, range(20 - MAX_WAITING, 20))]


def test_failure_in_the_thread_reaches_the_tracking() -> None:
    def job() -> None:
        raise ZeroDivisionError

    worker = ThreadedKeyframeWorker(times(inline=False))
    worker.submit(job, answers=True)
    with pytest.raises(ZeroDivisionError):
        poll_for_ever(worker)
    worker.close()
