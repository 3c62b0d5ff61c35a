# SPDX-License-Identifier: Apache-2.0
"""Spreads the work on images over processes, and that on pairs over threads."""

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import contextmanager
from multiprocessing.connection import wait
from pathlib import Path
from typing import TypeVar

from edge.config.features import OrbConfig
from maps.describe import Describer, Description
from maps.settings import BuildSettings
from maps.views import View

A = TypeVar("A")
B = TypeVar("B")

_describer: Describer | None = None  # of a worker process


def describe_all(
    roots: list[Path],
    views: Sequence[View],
    extractor: OrbConfig,
    settings: BuildSettings,
    workers: int,
) -> Iterator[Description]:
    """Descriptions of the views, in their order, whichever process made them."""
    if workers == 1:
        describer = Describer(roots, extractor, settings)
        yield from map(describer.describe, views)
        return
    # Spawned, not forked: the parent has threads of Numba and OpenCV.
    pool = ProcessPoolExecutor(
        workers,
        multiprocessing.get_context("spawn"),
        initializer=_start_worker,
        initargs=(roots, extractor, settings),
    )
    try:
        with _children_deaf_to_interrupts():
            described = pool.map(_describe, views, chunksize=4)  # starts the processes
        yield from described
    finally:
        pool.shutdown(cancel_futures=True)


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


def map_threads(function: Callable[[A], B], items: Sequence[A], workers: int) -> Iterator[B]:
    """Results in the order of the items; kernels release the GIL, so threads are enough."""
    if workers == 1:
        yield from map(function, items)
        return
    pool = ThreadPoolExecutor(workers)
    try:
        yield from pool.map(function, items)
    finally:
        pool.shutdown(cancel_futures=True)


def _start_worker(roots: list[Path], extractor: OrbConfig, settings: BuildSettings) -> None:
    global _describer  # a process pool gives its functions no other place
    threading.Thread(target=_end_with_parent, daemon=True).start()
    _describer = Describer(roots, extractor, settings)


def _end_with_parent() -> None:
    """A worker whose parent was killed would wait for work for ever."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)


def _describe(view: View) -> Description:
    assert _describer is not None
    return _describer.describe(view)
