# SPDX-License-Identifier: Apache-2.0
from pathlib import Path

import pytest

from edge.runtime.map_switch import Localised
from maps.bundle_keys import make_key, rotate_key
from tests.edge.runtime.swap_device import Device, until
from tests.edge.store.made_bundles import Workstation


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Workstation:
    bench = Workstation(tmp_path_factory.mktemp("bench") / "bench")
    bench.bundle(1)
    return bench


def test_a_bundle_in_the_inbox_is_used_and_believed(tmp_path: Path, bench: Workstation) -> None:
    device = Device(tmp_path, bench, good_after_s=0.01)
    with device.keeper():
        answer = device.drop(2)
        until(answer.exists)
        assert answer.read_text().startswith("OK: generation 2 (site hall, version 2) is in use")
        until(lambda: device.store.linked("good") == 2)
    assert device.host.map_folder == device.store.map_folder(device.store.generation(2))
    assert device.host.rehearsed == [True]
    assert "generation 2 (site hall, version 2) is in use" in device.host.told
    assert device.store.linked("current") == 2
    assert not answer.with_name("hall-2.mapbundle").exists()


def test_a_refusal_changes_nothing_and_is_told_everywhere(
    tmp_path: Path, bench: Workstation
) -> None:
    device = Device(tmp_path, bench)
    device.host.refusal = "not found here"
    with device.keeper():
        answer = device.drop(2)
        until(answer.exists)
    assert answer.read_text().startswith("REFUSED: not found here")
    assert device.host.told == ["hall-2.mapbundle refused: not found here"]
    assert device.store.linked("current") == 1
    assert answer.with_name("hall-2.mapbundle").exists()


def test_a_damaged_bundle_is_answered(tmp_path: Path, bench: Workstation) -> None:
    device = Device(tmp_path, bench)
    (device.store.inbox / "bad.mapbundle").write_bytes(b"noise" * 100)
    answer = device.store.inbox / "bad.mapbundle.result.txt"
    with device.keeper():
        until(answer.exists)
    assert "is no bundle" in answer.read_text()
    assert device.host.rehearsed == []


def test_a_map_that_proves_damaged_gives_way_to_the_one_before(
    tmp_path: Path, bench: Workstation
) -> None:
    device = Device(tmp_path, bench)
    device.store.activate(device.install(2))
    device.host.map_folder = device.store.map_folder(device.store.generation(2))
    with device.keeper() as keeper:
        device.drop_map(keeper)
        until(lambda: bool(device.host.told))
    assert device.host.told[0].endswith(
        "is damaged: returned to generation 1 (site hall, version 1)"
    )
    assert device.host.rehearsed == [False]
    assert device.store.linked("current") == 1


def test_the_only_map_proves_damaged_and_comes_again(tmp_path: Path, bench: Workstation) -> None:
    device = Device(tmp_path, bench)
    with device.keeper() as keeper:
        device.drop_map(keeper)
        answer = device.drop(1)
        until(answer.exists)
    assert answer.read_text().startswith("OK: generation 1")
    assert device.host.rehearsed == [True]


def test_a_map_that_comes_just_when_the_one_before_proves_damaged_stays(
    tmp_path: Path, bench: Workstation
) -> None:
    device = Device(tmp_path, bench)
    swap, damaged = device.host.swap, device.host.map_folder

    def drop_and_swap(map_folder: Path, rehearse: bool = True) -> None:
        assert damaged is not None
        if map_folder != damaged:
            keeper.return_from_damage(damaged)  # by the daemon, while this map is tried
        swap(map_folder, rehearse)

    device.host.swap = drop_and_swap  # type: ignore[method-assign]
    with device.keeper() as keeper:
        until(device.drop(2).exists)
        until(device.drop(3).exists)  # so the loop has gone on
    assert device.host.map_folder == device.store.map_folder(device.store.generation(3))
    assert not any("damaged" in text for text in device.host.told)


@pytest.mark.parametrize("wish", ["wanted", "forced"])
def test_a_wish_is_carried_out_and_answered(tmp_path: Path, bench: Workstation, wish: str) -> None:
    device = Device(tmp_path, bench)
    device.install(2)
    with device.keeper():
        device.store.link(wish, 2)
        until(lambda: device.store.outcome() is not None)
    outcome = device.store.outcome()
    assert outcome is not None
    assert (outcome.number, outcome.ok) == (2, True)
    assert device.store.linked(wish) is None
    assert device.host.rehearsed == [wish == "wanted"]


def test_a_map_that_finds_nothing_where_the_old_one_did_gives_way(
    tmp_path: Path, bench: Workstation
) -> None:
    device = Device(tmp_path, bench, good_after_s=0.2)
    device.host.counts, device.host.counts_after = Localised(500, 480), Localised(300, 2)
    with device.keeper():
        device.store.link("good", 1)
        device.drop(2)
        until(lambda: any("returned to generation 1" in text for text in device.host.told))
    assert device.store.linked("current") == 1
    assert device.host.rehearsed == [True, False]
    assert "located 2 of 300 frames" in device.host.told[-1]


def test_a_map_put_in_while_nothing_was_found_stays(tmp_path: Path, bench: Workstation) -> None:
    device = Device(tmp_path, bench, good_after_s=0.01)
    device.host.counts, device.host.counts_after = Localised(500, 0), Localised(300, 0)
    with device.keeper():
        device.drop(2)
        until(lambda: device.store.linked("good") == 2)
    assert device.store.linked("current") == 2


def test_keys_come_through_the_inbox(tmp_path: Path, bench: Workstation) -> None:
    device = Device(tmp_path, bench)
    new = make_key(tmp_path / "new.pem")
    statement = rotate_key(bench.key.private, new.private, retire=False)
    with device.keeper():
        (device.store.inbox / statement.name).write_bytes(statement.read_bytes())
        until((device.store.inbox / f"{statement.name}.result.txt").exists)
    assert [path.stem for path in device.store.keys.glob("*.pub")] == [new.id]


def test_the_generation_in_use_is_not_collected(tmp_path: Path, bench: Workstation) -> None:
    device = Device(tmp_path, bench)
    for version in (2, 3, 4):
        generation = device.install(version)
        device.store.activate(generation)
        device.store.mark_good(generation)
    with device.keeper():  # the daemon still uses generation 1
        device.store.collect()
        assert device.store.numbers() == [1, 3, 4]
    device.store.collect()
    assert device.store.numbers() == [3, 4]
