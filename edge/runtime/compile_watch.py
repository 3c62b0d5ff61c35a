# SPDX-License-Identifier: Apache-2.0
"""Notices kernels that are compiled when none should be."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from numba.core import event


class _Names(event.Listener):  # type: ignore[misc]  # numba ships no types
    """Collects what is compiled; loading from the cache does not count."""

    def __init__(self) -> None:
        self.names: list[str] = []

    def on_start(self, event: Any) -> None:
        function = event.data["dispatcher"].py_func
        self.names.append(f"{function.__module__}.{function.__qualname__}")

    def on_end(self, event: Any) -> None:
        """Nothing more to note."""


@contextmanager
def watch_compiles() -> Iterator[list[str]]:
    """Names of the kernels compiled in the block, one for each new combination of types."""
    listener = _Names()
    with event.install_listener("numba:compile", listener):
        yield listener.names
