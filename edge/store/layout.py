# SPDX-License-Identifier: Apache-2.0
"""The store's folder: names, links, locks and what can be read from them without a change."""

import fcntl
import logging
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from edge.errors import StoreError
from edge.store import durable
from edge.store.records import Generation, Outcome, Trial, read_note, record_name, record_number

log = logging.getLogger(__name__)

_LOCK_WAIT_S = 60.0


# Links that ask the daemon for a generation: if it does as well as the old one, or at once.
WISHES = ("wanted", "forced")


class Layout:
    """Where things lie. `current`, `good`, `previous` and WISHES are links to records."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.objects = root / "objects"
        self.maps = root / "maps"
        self.staging = root / "staging"
        self.inbox = root / "inbox"
        self.keys = root / "keys"

    def create(self) -> None:
        """Make all folders that are not there."""
        try:
            for folder in (self.objects, self.maps, self.staging, self.inbox, self.keys):
                durable.make_folder(folder)
        except OSError as error:
            raise StoreError(
                f"{self.root}: the store cannot be made: {error.strerror}; "
                "run as its owner or name another folder in tiles.store"
            ) from None

    def object(self, sha256: str) -> Path:
        """Where the file of that hash is, or would be."""
        return self.objects / sha256[:2] / sha256

    def record(self, number: int) -> Path:
        """Record of a generation."""
        return self.root / record_name(number)

    def numbers(self) -> list[int]:
        """Numbers of all generations that have a record, ascending."""
        names = (path.name for path in self.root.iterdir()) if self.root.is_dir() else ()
        return sorted(n for name in names if (n := record_number(name)) is not None)

    def sound_generations(self) -> list[Generation]:
        """Those whose records can be read, oldest first: a damaged one must not stop the others."""
        sound = []
        for number in self.numbers():
            try:
                sound.append(self.generation(number))
            except StoreError as error:
                log.warning("event=record_left_out %s", error)
        return sound

    def generation(self, number: int) -> Generation:
        """Record of one generation; StoreError if there is none."""
        record = read_note(self.record(number), Generation, "install its bundle again")
        if record is None or record.number != number:
            known = ", ".join(map(str, self.numbers())) or "none"
            raise StoreError(f"{self.root}: has no generation {number}; it has {known}")
        return record

    def linked(self, name: str) -> int | None:
        """Generation that the link `name` leads to; None where it leads to none."""
        try:
            number = record_number(str((self.root / name).readlink()))
        except OSError:
            return None
        return number if number is not None and self.record(number).is_file() else None

    def link(self, name: str, number: int) -> None:
        """Let a link lead to a generation from now on."""
        durable.point(self.root / name, record_name(number))

    def map_folder(self, generation: Generation) -> Path:
        """Folder to be opened as a map."""
        return self.maps / generation.folder_name

    def map_folders(self, number: int) -> list[Path]:
        """Folders of that generation, whose record may be damaged, and of one before it."""
        return list(self.maps.glob(f"{number}-*"))

    def trial(self) -> Trial | None:
        """The start on trial that was noted last."""
        return read_note(self.root / "trial.json", Trial)

    def outcome(self) -> Outcome | None:
        """What became of the last wish."""
        return read_note(self.root / "outcome.json", Outcome)

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Let nobody else change the store meanwhile."""
        with self._open("lock") as descriptor:
            deadline = time.monotonic() + _LOCK_WAIT_S
            while not _try_lock(descriptor, fcntl.LOCK_EX):
                if time.monotonic() > deadline:
                    raise StoreError(f"{self.root}: another command works on the store; wait")
                time.sleep(0.05)
            yield

    @contextmanager
    def daemon(self) -> Iterator[None]:
        """Be the one daemon that uses this store."""
        with self._open("daemon.lock") as descriptor:
            if not _try_lock(descriptor, fcntl.LOCK_EX):
                raise StoreError(f"{self.root}: another mapvo run uses this store; end it")
            yield

    def daemon_runs(self) -> bool:
        """Whether a daemon uses this store now."""
        if not (self.root / "daemon.lock").exists():
            return False
        with self._open("daemon.lock") as descriptor:
            return not _try_lock(descriptor, fcntl.LOCK_SH)

    @contextmanager
    def holding(self, generation: Generation) -> Iterator[None]:
        """Keep the generation from being collected while it is in use."""
        descriptor = os.open(self.map_folder(generation), os.O_RDONLY | os.O_CLOEXEC)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_SH)
            yield
        finally:
            os.close(descriptor)

    def in_use(self, folder: Path) -> bool:
        """Whether somebody holds the map in `folder`."""
        descriptor = os.open(folder, os.O_RDONLY | os.O_CLOEXEC)
        try:
            return not _try_lock(descriptor, fcntl.LOCK_EX)
        finally:
            os.close(descriptor)

    def held(self) -> Generation | None:
        """The newest generation that is held: while one takes the place of another, both are.

        None where nobody holds any, or its record is damaged.
        """
        for generation in reversed(self.sound_generations()):
            folder = self.map_folder(generation)
            if folder.is_dir() and self.in_use(folder):
                return generation
        return None

    @contextmanager
    def _open(self, name: str) -> Iterator[int]:
        path = self.root / name
        try:
            descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        except OSError as error:
            raise StoreError(
                f"{path}: cannot be opened: {error.strerror}; run as the store's owner"
            ) from None
        try:
            yield descriptor
        finally:
            os.close(descriptor)


def _try_lock(descriptor: int, kind: int) -> bool:
    try:
        fcntl.flock(descriptor, kind | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True
