# SPDX-License-Identifier: Apache-2.0
"""Folders where people drop bundles, and the answers written beside them.

What lies there is the truth, found by looking; inotify only says when to look at once.
"""

import ctypes
import errno
import logging
import os
import select
from collections.abc import Iterable, Sequence
from pathlib import Path

from edge.store import durable
from edge.store.bundle import SUFFIX, is_whole
from edge.store.regular import read_start
from edge.store.trust import STATEMENT_SUFFIX

RESULT_SUFFIX = ".result.txt"
_SETTLED_LOOKS = 2  # a file that has grown no more between so many looks is as it stays
_MAX_RESULT_BYTES = 4096
_IN_CLOSE_WRITE, _IN_MOVED_TO, _IN_ONLYDIR = 0x8, 0x80, 0x01000000
_IN_FLAGS = os.O_NONBLOCK | os.O_CLOEXEC

log = logging.getLogger(__name__)


class Inbox:
    """Some folders; each bundle in them is given out once, and again if it changes.

    `own` is the store's: what was taken from there is removed. `wait` ends for a change in the
    `wishes` folder, too. Owned by one thread, but `wake` may be called by any.
    """

    def __init__(self, own: Path, others: Sequence[Path] = (), wishes: Path | None = None) -> None:
        self._own = own
        self._folders = [own, *others]
        self._watched = [*self._folders, *([] if wishes is None else [wishes])]
        self._answered: dict[Path, str] = {}
        self._looks: dict[Path, tuple[str, int]] = {}
        self._notify = _open_inotify()
        self._woken, self._waker = os.pipe2(_IN_FLAGS)

    def close(self) -> None:
        """Free what the system lent."""
        for descriptor in (self._notify, self._woken, self._waker):
            if descriptor >= 0:
                os.close(descriptor)

    def wake(self) -> None:
        """End a `wait`."""
        os.write(self._waker, b".")

    def wait(self, timeout_s: float) -> None:
        """Until something may have changed in a folder, `wake`, or the time is over."""
        self._watch(self._watched)
        watched = [fd for fd in (self._notify, self._woken) if fd >= 0]
        ready, _, _ = select.select(watched, [], [], timeout_s)
        for descriptor in ready:
            try:
                while os.read(descriptor, 4096):
                    pass
            except BlockingIOError:
                pass

    def look(self) -> list[Path]:
        """Files to be taken now: new or changed, and not in the middle of being copied."""
        found = []
        for folder in self._folders:
            found += [path for path in _candidates(folder) if self._is_due(path)]
        return found

    def answer(self, path: Path, ok: bool, text: str) -> None:
        """Write beside a file what became of it, for who has nothing but the stick."""
        identity = _identity(path)
        self._answered[path] = identity
        word = "OK" if ok else "REFUSED"
        result = f"{word}: {text}\n({path.name}, {identity})\n"
        try:
            if ok and path.parent == self._own:
                durable.remove(path)
            durable.write_whole(path.with_name(path.name + RESULT_SUFFIX), result.encode())
        except OSError as error:
            log.info("event=no_answer_beside file=%s reason=%s", path, error.strerror)

    def _is_due(self, path: Path) -> bool:
        identity = _identity(path)
        if self._answered.get(path) == identity or f"({path.name}, {identity})" in _result(path):
            return False
        last, looks = self._looks.get(path, ("", 0))
        looks = looks + 1 if last == identity else 1
        self._looks[path] = identity, looks
        if path.suffix == SUFFIX and not is_whole(path):
            return looks > _SETTLED_LOOKS
        return True

    def _watch(self, folders: Iterable[Path]) -> None:
        """Adding a watch again is none; a folder that came back since gets its own."""
        if self._notify < 0:
            return
        libc = ctypes.CDLL(None, use_errno=True)
        for folder in folders:
            mask = _IN_CLOSE_WRITE | _IN_MOVED_TO | _IN_ONLYDIR
            libc.inotify_add_watch(self._notify, os.fsencode(folder), mask)


def _open_inotify() -> int:
    """Descriptor of an inotify queue; -1 where the system has none left."""
    libc = ctypes.CDLL(None, use_errno=True)
    descriptor: int = libc.inotify_init1(_IN_FLAGS)
    if descriptor < 0:
        log.warning("event=no_inotify reason=%s", errno.errorcode.get(ctypes.get_errno()))
    return descriptor


def _candidates(folder: Path) -> list[Path]:
    try:
        paths = sorted(folder.iterdir())
    except OSError:
        return []  # a stick that is not there
    suffixes = (SUFFIX, STATEMENT_SUFFIX)
    return [path for path in paths if path.suffix in suffixes and not path.name.startswith(".")]


def _identity(path: Path) -> str:
    """What changes when a file is copied anew."""
    try:
        status = path.lstat()
    except OSError:
        return "gone"
    return f"{status.st_size} bytes, {status.st_mtime_ns}"


def _result(path: Path) -> str:
    """Answer that lies beside a file, from an earlier start."""
    answer = path.with_name(path.name + RESULT_SUFFIX)
    return read_start(answer, _MAX_RESULT_BYTES).decode(errors="replace")
