# SPDX-License-Identifier: Apache-2.0
"""Who does the work on images and pairs: this process, others beside it, or a Dask cluster.

A function that is mapped is a module's own (or a `partial` of one), as it must be found by its
name elsewhere. Results come in the order of the items, so that it does not matter who made them.
"""

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing.connection import wait
from typing import Protocol, TypeVar

import cv2

A = TypeVar("A")
B = TypeVar("B")


class Workers(Protocol):
    """What a build gives its work to."""

    def map(self, function: Callable[[A], B], items: Sequence[A]) -> Iterator[B]:
        """Results of all items, in their order."""
        ...


class _Alone:
    """All work in this process."""

    def map(self, function: Callable[[A], B], items: Sequence[A]) -> Iterator[B]:
        cv2.setNumThreads(1)
        return map(function, items)


class _Processes:
    """Processes that live as long as the build; started with the first work."""

    def __init__(self, count: int) -> None:
        # Spawned, not forked: the parent has threads of Numba and OpenCV.
        context = multiprocessing.get_context("spawn")
        self._pool = ProcessPoolExecutor(count, context, initializer=_start_worker)

    def map(self, function: Callable[[A], B], items: Sequence[A]) -> Iterator[B]:
        with _children_deaf_to_interrupts():
            # The first submission starts the processes.
            return self._pool.map(function, items, chunksize=4 if len(items) > 64 else 1)

    def close(self) -> None:
        self._pool.shutdown(cancel_futures=True)


@contextmanager
def open_workers(count: int, dask: str | None = None) -> Iterator[Workers]:
    """Give `count` processes, or the cluster whose scheduler is at the address `dask`."""
    if dask is not None:
        # Imported only here: it takes half a second, and most builds need no cluster.
        from maps.cluster import open_cluster

        with open_cluster(dask) as cluster:
            yield cluster
    elif count == 1:
        yield _Alone()
    else:
        processes = _Processes(count)
        try:
            yield processes
        finally:
            processes.close()


@contextmanager
def _children_deaf_to_interrupts() -> Iterator[None]:
    """Start processes that ignore Ctrl-C from their first moment; the parent alone decides.

    Ctrl-C goes to the whole group of processes. A signal in the middle of a start would leave a
    child without its orders, so SIGTERM waits until all have started.
    """
    if threading.current_thread() is not threading.main_thread():
        yield  # only the main thread gets signals, and sets what they do
        return
    waiting: list[int] = []
    old = {
        signal.SIGINT: signal.signal(signal.SIGINT, signal.SIG_IGN),
        signal.SIGTERM: signal.signal(signal.SIGTERM, lambda number, _: waiting.append(number)),
    }
    try:
        yield
    finally:
        for number, handler in old.items():
            signal.signal(number, handler)
    if waiting:
        signal.raise_signal(waiting[0])


def _start_worker() -> None:
    threading.Thread(target=_end_with_parent, daemon=True).start()
    cv2.setNumThreads(1)


def _end_with_parent() -> None:
    """A worker whose parent was killed would wait for work for ever."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)
