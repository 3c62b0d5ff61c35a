# SPDX-License-Identifier: Apache-2.0
"""What is done to the store while its disk is watched: arguments FOLDER BUNDLES [WITHOUT].

After each step the state that has to be on the disk from now on goes to standard output, and the
work waits for a line. WITHOUT is `file` or `folder`: syncs of those are left out, to show that
the test would notice.
"""

import os
import stat
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from edge.store import durable
from edge.store.bundle import Device, open_bundle
from edge.store.store import Store
from edge.store.trust import TrustedKeys

FILES_IN_FOLDER = 3


class State(NamedTuple):
    """What a mounted disk shows."""

    current: int
    good: int
    folder: int  # what each file of the replaced folder says
    installed: frozenset[int]

    def text(self) -> str:
        """One line."""
        installed = ",".join(map(str, sorted(self.installed)))
        return f"{self.current} {self.good} {self.folder} {installed}"


def parse(text: str) -> State:
    """The state of a line."""
    current, good, folder, installed = text.split(" ")
    numbers = frozenset(int(number) for number in installed.split(","))
    return State(int(current), int(good), int(folder), numbers)


def write_folder(root: Path, number: int) -> None:
    """Replace a folder of files as maps and runs are replaced."""
    partial = root / ".folder.part"
    partial.mkdir()
    for name in range(FILES_IN_FOLDER):
        durable.write_new(partial / f"{name}", [f"{number}".encode() * 5000])
    durable.replace_folder(partial, root / "folder")


def prepare(root: Path, bundle: Path, keys: TrustedKeys) -> State:
    """Bring the disk to where the work begins."""
    store = Store(root / "store")
    with open_bundle(bundle, keys) as opened:
        generation = store.install(opened, Device(runtime="99.0"))
    store.activate(generation)
    store.mark_good(generation)
    write_folder(root, 1)
    return State(1, 1, 1, frozenset({1}))


def work(root: Path, bundles: Path) -> Iterator[State]:
    """Install, switch, return, collect; yields after each step what must stay."""
    store = Store(root / "store")
    keys = TrustedKeys([bundles / "trusted"])
    state = State(1, 1, 1, frozenset({1}))
    for number in (2, 3, 4):
        with open_bundle(bundles / f"hall-{number}.mapbundle", keys) as opened:
            generation = store.install(opened, Device(runtime="99.0"))
        state = state._replace(installed=state.installed | {number})
        yield state
        store.activate(generation)
        state = state._replace(current=number)
        yield state
        if number != 3:
            store.mark_good(generation)
            state = state._replace(good=number)
            yield state
        else:
            store.note_trial(generation.number)
        write_folder(root, number)
        state = state._replace(folder=number)
        yield state
    store.collect()  # generation 2 is `previous`, 1 and 3 go
    state = state._replace(installed=frozenset({2, 4}))
    yield state
    store.rollback()
    yield state._replace(current=2, good=2)


def leave_out_syncs(of: str) -> None:
    """Let syncs of files or of folders do nothing."""
    real = os.fsync
    wanted = {"file": stat.S_ISREG, "folder": stat.S_ISDIR}[of]

    def sync(descriptor: int) -> None:
        if not wanted(os.fstat(descriptor).st_mode):
            real(descriptor)

    os.fsync = sync  # type: ignore[assignment]


if __name__ == "__main__":
    if len(sys.argv) > 3:
        leave_out_syncs(sys.argv[3])
    for reached in work(Path(sys.argv[1]), Path(sys.argv[2])):
        sys.stdout.write(reached.text() + "\n")
        sys.stdout.flush()
        sys.stdin.readline()
