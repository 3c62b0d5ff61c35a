# SPDX-License-Identifier: Apache-2.0
import shutil
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import NamedTuple, TypeVar

import numpy as np
import pytest

from edge.cli.command_line import Stopped
from edge.errors import OutputError, RecordingError
from edge.types import DepthSamples
from maps.work_folder import WorkFolder, joined, key_of, stamp, taken_apart, work_folder

A = TypeVar("A")
B = TypeVar("B")


class Inner(NamedTuple):
    words: np.ndarray
    samples: DepthSamples


class Result(NamedTuple):
    square: np.ndarray
    inner: Inner


def result(number: int) -> Result:
    some = np.arange(number, dtype=np.float32)
    return Result(np.array([number**2]), Inner(some > 1, DepthSamples(some[:0], some, some + 1)))


class Counting:
    """Workers that say what they were given, and give up when they should."""

    def __init__(self, stop_after: int = 1000) -> None:
        self.given: list[object] = []
        self._left = stop_after

    def map(self, function: Callable[[A], B], items: Sequence[A]) -> Iterator[B]:
        for item in items:
            if self._left == 0:
                raise Stopped
            self._left -= 1
            self.given.append(item)
            yield function(item)


def run(work: WorkFolder, workers: Counting) -> list[int]:
    keys = [key_of("square", number) for number in range(6)]
    found = work.map(workers, result, range(6), keys, Result)
    return [int(each.square[0]) for each in found]


def test_a_result_comes_back_as_it_was() -> None:
    before = result(4)
    after = joined(Result, taken_apart(before))
    assert after.inner.samples.sigma.tolist() == [1, 2, 3, 4]
    assert after.inner.words.dtype == np.bool_
    assert after.inner.samples.pixels.shape == (0,)
    assert after.square.flags.writeable


def test_what_was_made_before_an_interruption_is_not_made_again(tmp_path: Path) -> None:
    place = tmp_path / "maps"  # which the map will make
    with pytest.raises(Stopped), work_folder(place / "map") as work:
        run(work, Counting(stop_after=4))
    assert [path.name for path in place.iterdir()] == [".map.work"]
    again = Counting()
    with work_folder(place / "map") as work:
        assert run(work, again) == [0, 1, 4, 9, 16, 25]
    assert again.given == [4, 5]
    assert list(place.iterdir()) == []


def refuse(work: WorkFolder) -> None:
    run(work, Counting())
    raise RecordingError("no")


def test_a_refused_build_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(RecordingError), work_folder(tmp_path / "map") as work:
        refuse(work)
    assert list(tmp_path.iterdir()) == []


def find_no_room(work: WorkFolder) -> None:
    run(work, Counting())
    raise OutputError("map: cannot be written; make room")


def test_a_build_without_room_for_its_map_goes_on_once_there_is_some(tmp_path: Path) -> None:
    with pytest.raises(OutputError), work_folder(tmp_path / "map") as work:
        find_no_room(work)
    again = Counting()
    with work_folder(tmp_path / "map") as work:
        run(work, again)
    assert again.given == []


@pytest.mark.parametrize("restarted", [False, True])
def test_results_leave_the_map_as_much_room_as_they_take(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, restarted: bool
) -> None:
    size, folder = 10_000, tmp_path / "work"

    def kept() -> int:
        return sum(path.stat().st_size for path in folder.iterdir())

    def usage(place: Path) -> SimpleNamespace:
        return SimpleNamespace(free=size - kept())

    monkeypatch.setattr(shutil, "disk_usage", usage)
    work = WorkFolder(folder)
    for number in range(40):
        work.keep(f"{number:02}", result(100))
        if restarted:
            work = WorkFolder(folder)
    assert 0.3 * size < kept() <= 0.5 * size


def with_other_value(data: bytes) -> bytes:
    """A result whose layout is right and whose first number is not: behind digest and header."""
    place = 40 + int.from_bytes(data[32:40], "little")
    return data[:place] + bytes([data[place] ^ 1]) + data[place + 1 :]


@pytest.mark.parametrize("spoil", [lambda b: b[:-1], lambda b: b"", with_other_value])
def test_a_spoiled_result_is_made_again(tmp_path: Path, spoil: Callable[[bytes], bytes]) -> None:
    work = WorkFolder(tmp_path / "work")
    run(work, Counting())
    for path in (tmp_path / "work").iterdir():
        path.write_bytes(spoil(path.read_bytes()))
    again = Counting()
    assert run(work, again) == [0, 1, 4, 9, 16, 25]
    assert again.given == []  # by whoever noticed, not by the workers


def test_a_folder_that_cannot_be_made_keeps_nothing_and_does_no_harm(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    work = WorkFolder(tmp_path / "file" / "work")
    assert run(work, Counting()) == [0, 1, 4, 9, 16, 25]
    again = Counting()
    run(work, again)
    assert len(again.given) == 6


def test_the_name_of_a_result_follows_all_that_goes_into_it(tmp_path: Path) -> None:
    image = tmp_path / "image"
    image.write_bytes(b"1")
    keys = {key_of(stamp(image), np.eye(2))}
    keys.add(key_of(stamp(image), np.eye(2) * 2))
    image.write_bytes(b"12")
    keys.add(key_of(stamp(image), np.eye(2)))
    keys.add(key_of(stamp(image), "other", np.eye(2)))
    assert len(keys) == 4
    assert key_of("a", "bc") != key_of("ab", "c")
