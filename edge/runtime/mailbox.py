# SPDX-License-Identifier: Apache-2.0
"""How threads hand things to one another: never waiting, newest wins, losses counted."""

import threading
from collections import deque
from typing import Generic, TypeVar

T = TypeVar("T")


class Mailbox(Generic[T]):
    """A queue of bounded length; a full one loses its oldest item.

    Any thread may call anything. After `close` nothing comes in; what is inside
    can still be taken.
    """

    def __init__(self, capacity: int = 1) -> None:
        self._items: deque[T] = deque()
        self._capacity = capacity
        self._closed = False
        self._changed = threading.Condition()
        self._dropped = 0

    @property
    def dropped(self) -> int:
        """How many items were never taken because newer ones came."""
        return self._dropped

    def __len__(self) -> int:
        return len(self._items)

    def offer(self, item: T) -> None:
        """Put `item` in at once, in the oldest one's place if need be."""
        with self._changed:
            if self._closed:
                return
            if len(self._items) == self._capacity:
                self._items.popleft()
                self._dropped += 1
            self._items.append(item)
            self._changed.notify()

    @property
    def closed(self) -> bool:
        """Whether nothing more comes in."""
        return self._closed

    def take(self, timeout_s: float | None = None) -> T | None:
        """Wait for an item and return the oldest; None once closed and empty, or out of time."""
        with self._changed:
            self._changed.wait_for(lambda: self._items or self._closed, timeout_s)
            return self._items.popleft() if self._items else None

    def drain(self) -> list[T]:
        """All items, oldest first, without waiting."""
        with self._changed:
            items = list(self._items)
            self._items.clear()
            return items

    def close(self) -> None:
        """Let nothing more in and wake who waits."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
