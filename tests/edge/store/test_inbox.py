# SPDX-License-Identifier: Apache-2.0
import os
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from edge.store.bundle import HEAD, MAGIC
from edge.store.inbox import Inbox

WHOLE = HEAD.pack(MAGIC, 1, 0, 40).ljust(40, b"x")


@pytest.fixture
def folders(tmp_path: Path) -> tuple[Path, Path]:
    own, stick = tmp_path / "own", tmp_path / "stick"
    own.mkdir()
    stick.mkdir()
    return own, stick


@pytest.fixture
def inbox(folders: tuple[Path, Path]) -> Iterator[Inbox]:
    inbox = Inbox(folders[0], [folders[1], Path("/nowhere")])
    yield inbox
    inbox.close()


def test_each_bundle_is_given_once_until_it_changes(
    inbox: Inbox, folders: tuple[Path, Path]
) -> None:
    path = folders[1] / "a.mapbundle"
    path.write_bytes(WHOLE)
    assert inbox.look() == [path]
    inbox.answer(path, False, "no")
    assert inbox.look() == []
    path.write_bytes(WHOLE + b"more")
    assert inbox.look() == [path]


def test_an_answer_outlives_the_program(inbox: Inbox, folders: tuple[Path, Path]) -> None:
    path = folders[1] / "a.mapbundle"
    path.write_bytes(WHOLE)
    inbox.answer(path, True, "in use")
    assert (folders[1] / "a.mapbundle.result.txt").read_text().startswith("OK: in use\n")
    again = Inbox(folders[0], [folders[1]])
    assert again.look() == []
    again.close()


def test_what_was_taken_goes_from_the_own_folder_and_stays_on_the_stick(
    inbox: Inbox, folders: tuple[Path, Path]
) -> None:
    for folder in folders:
        (folder / "a.mapbundle").write_bytes(WHOLE)
        inbox.answer(folder / "a.mapbundle", True, "in use")
    assert not (folders[0] / "a.mapbundle").exists()
    assert (folders[1] / "a.mapbundle").exists()
    (folders[0] / "b.mapbundle").write_bytes(WHOLE)
    inbox.answer(folders[0] / "b.mapbundle", False, "no")
    assert (folders[0] / "b.mapbundle").exists()


def test_a_copy_under_way_is_waited_for_but_not_for_ever(
    inbox: Inbox, folders: tuple[Path, Path]
) -> None:
    path = folders[0] / "a.mapbundle"
    for length in (10, 20, 30):
        path.write_bytes(WHOLE[:length])
        assert inbox.look() == []
    path.write_bytes(WHOLE)
    assert inbox.look() == [path]
    path.write_bytes(WHOLE[:35])
    assert [inbox.look() for _ in range(3)] == [[], [], [path]]


def test_other_files_are_left_alone(inbox: Inbox, folders: tuple[Path, Path]) -> None:
    for name in ("notes.txt", ".hidden.mapbundle", "a.mapbundle.result.txt", "b.mapbundle.part"):
        (folders[0] / name).write_bytes(WHOLE)
    assert inbox.look() == []


def test_an_answer_never_follows_a_link(inbox: Inbox, folders: tuple[Path, Path]) -> None:
    victim = folders[0].parent / "victim"
    victim.write_text("keep")
    path = folders[1] / "a.mapbundle"
    path.write_bytes(WHOLE)
    (folders[1] / "a.mapbundle.result.txt").symlink_to(victim)
    inbox.answer(path, False, "no")
    assert victim.read_text() == "keep"


def test_a_folder_in_the_answers_place_is_no_trouble(
    inbox: Inbox, folders: tuple[Path, Path]
) -> None:
    path = folders[1] / "a.mapbundle"
    path.write_bytes(WHOLE)
    (folders[1] / "a.mapbundle.result.txt").mkdir()
    inbox.answer(path, False, "no")
    assert inbox.look() == []
    again = Inbox(folders[0], [folders[1]])
    assert again.look() == [path]
    again.close()


def test_waiting_ends_with_a_new_file_or_a_call(inbox: Inbox, folders: tuple[Path, Path]) -> None:
    for act in (lambda: (folders[0] / "a.mapbundle").write_bytes(WHOLE), inbox.wake):
        waiting = threading.Thread(target=inbox.wait, args=(3600.0,))
        waiting.start()
        while waiting.is_alive():  # the watch may not stand yet when it is first done
            act()
            waiting.join(0.05)


def test_nothing_stays_open(folders: tuple[Path, Path]) -> None:
    before = os.listdir("/proc/self/fd")  # noqa: PTH208  # the names are numbers
    inbox = Inbox(folders[0])
    inbox.wait(0.0)
    inbox.close()
    assert len(os.listdir("/proc/self/fd")) <= len(before)  # noqa: PTH208
