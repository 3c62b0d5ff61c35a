# SPDX-License-Identifier: Apache-2.0
"""Full disks and damaged records: the daemon goes on, and says what is true.

A folder in a file's place stands for a disk that is full: neither can be written.
"""

from pathlib import Path

import numpy as np
import pytest

from edge.errors import StoreError
from edge.runtime.map_switch import Localised
from edge.runtime.swap_boot import open_first
from edge.store.records import Generation
from tests.edge.runtime.swap_device import Device, until
from tests.edge.store.made_bundles import Workstation


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Workstation:
    bench = Workstation(tmp_path_factory.mktemp("bench") / "bench")
    bench.bundle(1)
    return bench


def test_a_damaged_record_of_the_map_before_leaves_the_new_one_in_use(
    tmp_path: Path, bench: Workstation
) -> None:
    device = Device(tmp_path, bench, good_after_s=0.01)

    def localised() -> Localised:  # asked for before the exchange, and when the trial ends
        if device.host.rehearsed:
            device.store.record(1).write_bytes(b"x")
        return Localised(300, 2) if device.host.rehearsed else Localised(500, 480)

    device.host.localised = localised  # type: ignore[method-assign]
    with device.keeper() as keeper:
        device.drop(2)
        until(lambda: any("no other can be told" in text for text in device.host.told))
        keeper.check()
    assert device.store.linked("current") == 2


def test_a_map_that_could_not_be_made_current_is_so_at_the_next_try(
    tmp_path: Path, bench: Workstation
) -> None:
    device = Device(tmp_path, bench)
    link = device.store.root / "current"
    link.unlink()
    link.mkdir()
    with device.keeper():
        answer = device.drop(2)
        until(answer.exists)
        assert "in use, but only until the next start" in answer.read_text()
        link.rmdir()
        answer.unlink()
        device.drop(2)
        until(answer.exists)
    assert answer.read_text().startswith("OK")
    assert device.store.linked("current") == 2
    assert device.host.rehearsed == [True]


def test_a_map_that_could_not_be_made_current_is_so_when_it_is_believed(
    tmp_path: Path, bench: Workstation
) -> None:
    device = Device(tmp_path, bench, good_after_s=0.01)
    link = device.store.root / "current"

    def localised() -> Localised:  # asked for before the exchange, and when the trial ends
        if device.host.rehearsed:
            link.rmdir()
        return Localised(0, 0)

    device.host.localised = localised  # type: ignore[method-assign]
    link.unlink()
    link.mkdir()
    with device.keeper():
        answer = device.drop(2)
        until(lambda: device.store.linked("good") == 2)
    assert "only until the next start" in answer.read_text()
    assert device.store.linked("current") == 2


def fails(device: Device, step: str, times: float) -> None:
    """Let so many of the next calls of a step of the store find the disk full."""
    work, left = getattr(device.store, step), times

    def work_or_fail(generation: Generation) -> None:
        nonlocal left
        left -= 1
        if left >= 0:
            raise StoreError("No space left on device")
        work(generation)

    setattr(device.store, step, work_or_fail)


@pytest.mark.parametrize("step", ["activate", "mark_good"])
def test_what_could_not_be_noted_of_a_map_is_noted_once_there_is_room(
    tmp_path: Path, bench: Workstation, step: str
) -> None:
    device = Device(tmp_path, bench, good_after_s=0.01)
    with device.keeper() as keeper:
        fails(device, step, times=4)
        device.drop(2)
        until(lambda: device.store.linked("good") == 2)
        keeper.check()
    assert device.store.linked("current") == 2
    assert device.host.rehearsed == [True]
    # In the answer; then again, but not at each try.
    assert len([text for text in device.host.told if "No space" in text]) <= 2


@pytest.mark.parametrize("why", ["located 2 of 300 frames", "is damaged"])
def test_a_bad_map_that_could_not_be_made_current_gives_way_to_the_good_one(
    tmp_path: Path, bench: Workstation, why: str
) -> None:
    finds_nothing = why.startswith("located")
    device = Device(tmp_path, bench, good_after_s=0.2 if finds_nothing else 3600.0)
    if finds_nothing:
        device.host.counts, device.host.counts_after = Localised(500, 480), Localised(300, 2)
    fails(device, "activate", times=np.inf)
    with device.keeper() as keeper:
        until(device.drop(2).exists)
        if not finds_nothing:
            device.drop_map(keeper)
        until(lambda: any("returned to generation 1" in text for text in device.host.told))
    assert any(why in text for text in device.host.told)
    assert device.host.rehearsed == [True, False]


def test_a_return_that_could_not_be_noted_is_noted_once_there_is_room(
    tmp_path: Path, bench: Workstation
) -> None:
    device = Device(tmp_path, bench, good_after_s=0.01)
    device.store.activate(device.install(2))
    device.host.map_folder = device.store.map_folder(device.store.generation(2))
    fails(device, "activate", times=3)
    with device.keeper() as keeper:
        device.drop_map(keeper)
        until(lambda: device.store.linked("current") == 1)
        keeper.check()


def test_an_answer_that_cannot_be_written_ends_nothing(tmp_path: Path, bench: Workstation) -> None:
    device = Device(tmp_path, bench)
    device.install(2)
    (device.store.root / "outcome.json").mkdir()
    with device.keeper() as keeper:
        device.store.link("wanted", 2)
        until(lambda: any("outcome.json" in text for text in device.host.told))
        keeper.check()
        assert device.store.linked("wanted") is None
        until(device.drop(3).exists)
    assert device.store.linked("current") == 3


@pytest.mark.parametrize("way", ["inbox", "wish"])
def test_a_map_that_breaks_the_numbers_down_is_refused_and_not_tried_for_ever(
    tmp_path: Path, bench: Workstation, way: str
) -> None:
    device = Device(tmp_path, bench)

    def break_down(map_folder: Path, rehearse: bool = True) -> None:
        raise np.linalg.LinAlgError("Singular matrix")

    device.host.swap = break_down  # type: ignore[method-assign]
    if way == "wish":
        device.install(2)
    with device.keeper() as keeper:
        if way == "inbox":
            answer = device.drop(2)
            until(answer.exists)
            assert answer.read_text().startswith("REFUSED: failed (LinAlgError: Singular matrix)")
        else:
            device.store.link("wanted", 2)
            until(lambda: device.store.outcome() is not None)
            assert device.store.linked("wanted") is None
        keeper.check()
    assert device.store.linked("current") == 1


def test_a_wish_that_comes_while_another_is_carried_out_is_not_lost(
    tmp_path: Path, bench: Workstation
) -> None:
    device = Device(tmp_path, bench)
    device.install(2)
    device.install(3)
    swap = device.host.swap

    def swap_and_wish(map_folder: Path, rehearse: bool = True) -> None:
        swap(map_folder, rehearse)
        if map_folder.name.startswith("2-"):
            device.store.link("wanted", 3)

    device.host.swap = swap_and_wish  # type: ignore[method-assign]
    with device.keeper():
        device.store.link("wanted", 2)
        until(lambda: device.store.linked("current") == 3)


@pytest.mark.parametrize("note", ["trial.json", "current"])
def test_the_daemon_starts_with_a_map_though_nothing_can_be_noted(
    tmp_path: Path, bench: Workstation, note: str
) -> None:
    device = Device(tmp_path, bench)
    device.store.activate(device.install(2))
    path = device.store.root / note
    path.unlink(missing_ok=True)
    path.mkdir()
    folder = open_first(device.store, 3, lambda folder: folder)
    assert folder is not None
    assert folder.name.startswith("2-" if note == "trial.json" else "1-")
