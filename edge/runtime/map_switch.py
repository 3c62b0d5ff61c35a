# SPDX-License-Identifier: Apache-2.0
"""Exchanges the map of the running daemon between two frames.

What the tile store needs of the daemon is `MapHost`: it swaps, watches whether frames are
still found, and swaps back if they are not.
"""

import threading
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple, Protocol

from edge.errors import EdgeError
from edge.runtime.live import OpenedMap
from edge.runtime.search import Search


class Localised(NamedTuple):
    """How many frames were tracked since the map was put in, and how many had a map pose."""

    tracked: int
    published: int


ENDS = "the program ends"


class SwapRefused(EdgeError):
    """The map was not exchanged; the old one is still in use."""


class MapHost(Protocol):
    """The daemon as the tile store sees it. Any thread but the tracking one may call it."""

    @property
    def map_folder(self) -> Path | None:
        """Folder of the map in use."""
        ...

    def swap(self, map_folder: Path) -> None:
        """Open `map_folder` beside the running map, then use it from the next frame on.

        Returns once it is in use. EdgeError says why it is not: then nothing has changed.
        """
        ...

    def localised(self) -> Localised:
        """Counts since the map in use was put in."""
        ...

    def tell(self, text: str) -> None:
        """Say one line on every channel: journal, status topic, serial line."""
        ...


class MapSwitch:
    """Hands an opened map to the tracking thread and waits until it is in use.

    `open_beside` opens a folder or raises EdgeError; it runs in the thread that asks.
    """

    def __init__(self, open_beside: Callable[[Path], OpenedMap], timeout_s: float = 5.0) -> None:
        self._open_beside = open_beside
        self._timeout_s = timeout_s
        self._asking = threading.Lock()  # one swap at a time
        self._changed = threading.Condition()
        self._waiting: OpenedMap | None = None
        self._replaced: Search | None = None
        self._closed = False

    def swap(self, map_folder: Path) -> None:
        """Return once the map in `map_folder` is in use; else EdgeError, and nothing changed."""
        with self._asking:
            opened = self._open_beside(map_folder)
            with self._changed:
                self._waiting = opened
                self._changed.wait_for(lambda: self._replaced or self._closed, self._timeout_s)
                replaced, self._replaced, self._waiting = self._replaced, None, None
        if replaced is None:
            opened.search.close()
            late = (
                f"no frame or pause between two came within {self._timeout_s:g} s; see `status` "
                "for what holds the tracking up"
            )
            raise SwapRefused(f"{map_folder}: not put in: {ENDS if self._closed else late}")
        replaced.close()

    def close(self) -> None:
        """Let nobody wait any longer: the tracking has ended."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    def apply(self, use: Callable[[OpenedMap], Search]) -> bool:
        """Let `use` put in what waits, if anything does; for the tracking thread, never waits.

        `use` returns the search that is no longer needed.
        """
        if self._waiting is None:
            return False
        with self._changed:
            opened, self._waiting = self._waiting, None
            if opened is None:
                return False
            self._replaced = use(opened)
            self._changed.notify_all()
        return True
