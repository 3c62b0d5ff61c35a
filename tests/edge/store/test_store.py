# SPDX-License-Identifier: Apache-2.0
import shutil
from pathlib import Path

import pytest

from edge.errors import BundleRefused, StoreError, TileError
from edge.runtime.swap_boot import open_first
from edge.store.records import Generation, Outcome
from edge.store.store import Store
from edge.tiles.reader import open_map
from maps.bundle import BundleOrder
from tests.edge.store.made_bundles import RUNTIME, Workstation
from tests.maps.small_map import edited_manifest


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Workstation:
    return Workstation(tmp_path_factory.mktemp("bench") / "bench")


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return Store(tmp_path / "store")


def install(store: Store, bench: Workstation, version: int, seed: int | None = None) -> Generation:
    with bench.open(bench.bundle(version, seed)) as bundle:
        return store.install(bundle, RUNTIME)


def use(store: Store, generation: Generation) -> None:
    store.activate(generation)
    store.mark_good(generation)


def test_what_is_installed_is_used_only_when_asked_for(store: Store, bench: Workstation) -> None:
    first = install(store, bench, 1)
    assert (first.number, store.linked("current")) == (1, None)
    use(store, first)
    second = install(store, bench, 2)
    assert store.linked("current") == 1
    store.activate(second)
    assert (store.linked("current"), store.linked("good")) == (2, 1)


def test_the_same_bundle_again_is_the_same_generation(store: Store, bench: Workstation) -> None:
    assert install(store, bench, 1) == install(store, bench, 1)
    assert store.numbers() == [1]


def test_the_same_bundle_again_mends_what_is_damaged(store: Store, bench: Workstation) -> None:
    first = install(store, bench, 1)
    (tile,) = list((store.map_folder(first) / "tiles").iterdir())[:1]
    data = bytearray(tile.read_bytes())
    data[-1] ^= 1
    tile.chmod(0o644)
    tile.write_bytes(data)
    assert install(store, bench, 1) == first
    open_map(store.map_folder(first), verify=True)


def test_an_older_version_never_comes_back_from_outside(store: Store, bench: Workstation) -> None:
    use(store, install(store, bench, 2))
    with pytest.raises(BundleRefused, match="version 2 of site hall was here"):
        install(store, bench, 1)
    for version in (3, 4, 5):
        use(store, install(store, bench, version))
    store.collect()
    assert 1 not in store.numbers()
    with pytest.raises(BundleRefused, match="version 5"):
        install(store, bench, 2)


def test_rollback_goes_from_a_trial_to_the_good_one_and_from_that_to_the_one_before(
    store: Store, bench: Workstation
) -> None:
    for version in (1, 2):
        use(store, install(store, bench, version))
    store.activate(install(store, bench, 3))
    assert store.rollback().number == 2
    assert store.rollback().number == 1
    assert (store.linked("current"), store.linked("good")) == (1, 1)
    with pytest.raises(StoreError, match="no other good generation"):
        store.rollback()


def test_of_two_generations_held_in_a_change_the_newer_is_the_one_in_use(
    store: Store, bench: Workstation
) -> None:
    first, second = (install(store, bench, version) for version in (1, 2))
    assert store.held() is None
    with store.holding(first):
        assert store.held() == first
        with store.holding(second):
            assert store.held() == second
    assert store.held() is None


def test_collecting_keeps_what_is_linked_newer_or_held(store: Store, bench: Workstation) -> None:
    generations = [install(store, bench, version) for version in range(1, 7)]
    for generation in generations[:5]:
        use(store, generation)
    held = generations[1]
    with store.holding(held):
        mapped = open_map(store.map_folder(held))
        store.collect()
        assert store.numbers() == [2, 4, 5, 6]
    store.collect()
    assert store.numbers() == [4, 5, 6]
    assert mapped.points(mapped.features(0).point[:0]).xyz.shape == (0, 3)
    assert mapped.T_map_cam.shape[0] == mapped.n_keyframes
    for generation in store.sound_generations():
        store.verify(generation)
    needed = {entry.sha256 for one in store.sound_generations() for entry in one.files}
    assert {path.name for path in store.objects.glob("*/*")} == needed


def test_a_damaged_record_stops_no_collecting(store: Store, bench: Workstation) -> None:
    generations = [install(store, bench, version) for version in (1, 2, 3, 4)]
    for generation in generations:
        use(store, generation)
    for number in (1, 3):  # 1 is not needed any more, 3 is what the store falls back to
        store.record(number).write_bytes(b"x")
    store.collect()
    assert store.numbers() == [3, 4]
    assert not store.map_folder(generations[0]).exists()
    open_map(store.map_folder(generations[2]), verify=True)
    needed = {entry.sha256 for one in generations[2:] for entry in one.files}
    assert {path.name for path in store.objects.glob("*/*")} == needed
    again = install(store, bench, 3)
    assert again == generations[2]


def test_damage_on_the_disk_is_found_and_healed_by_the_next_bundle(
    store: Store, bench: Workstation
) -> None:
    first = install(store, bench, 1)
    tile = store.map_folder(first) / first.files[-1].path
    data = bytearray(tile.read_bytes())
    data[-1] ^= 1
    tile.chmod(0o644)
    tile.write_bytes(data)
    with pytest.raises(StoreError, match="is damaged"):
        store.verify(first)
    second = install(store, bench, 2, seed=1)  # the same map
    store.verify(second)


def test_a_difference_needs_the_rest_on_the_device(store: Store, bench: Workstation) -> None:
    old, new = bench.map(1), bench.folder / "changed.map"
    if not new.exists():
        shutil.copytree(old, new)
        with edited_manifest(new) as manifest:
            manifest["frame"] = "map2"
        new.rename(bench.folder / "8.map")
    order = BundleOrder(site="hall", map_version=8, untested=True, runtime_min="0.1", base=old)
    path = bench.made(order, seed=8)
    assert path.stat().st_size < 10_000
    with bench.open(path) as bundle, pytest.raises(BundleRefused, match="lacks tiles/"):
        store.install(bundle, RUNTIME)
    install(store, bench, 1)
    with bench.open(path) as bundle:
        generation = store.install(bundle, RUNTIME)
    assert open_map(store.map_folder(generation)).manifest.frame == "map2"
    store.verify(generation)


def test_what_a_killed_installation_left_is_swept_away(store: Store, bench: Workstation) -> None:
    store.create()
    (store.staging / "half.part").write_bytes(b"half")
    (store.staging / "tmp" / "tiles").mkdir(parents=True)
    (store.maps / "1-000000000000").mkdir()
    (store.root / ".current.1.part").symlink_to("nowhere")
    install(store, bench, 1)
    store.collect()
    assert list(store.staging.iterdir()) == []
    assert [path.name[:2] for path in store.maps.iterdir()] == ["1-"]
    assert not (store.root / ".current.1.part").is_symlink()


def test_a_torn_link_counts_as_none(store: Store, bench: Workstation) -> None:
    install(store, bench, 1)
    for target in ("generation-7.json", "/etc/passwd", "generation-01.json"):
        (store.root / "current").unlink(missing_ok=True)
        (store.root / "current").symlink_to(target)
        assert store.linked("current") is None


def test_an_outcome_ends_the_wish(store: Store, bench: Workstation) -> None:
    generation = install(store, bench, 1)
    store.link("wanted", generation.number)
    store.note_outcome(Outcome(1, True, "done"))
    assert store.linked("wanted") is None
    assert store.outcome() == Outcome(1, True, "done")


def test_the_daemon_is_alone_and_seen(store: Store) -> None:
    store.create()
    assert not store.daemon_runs()
    with store.daemon():
        assert store.daemon_runs()
        with pytest.raises(StoreError, match="another mapvo run"), store.daemon():
            pass
    assert not store.daemon_runs()


def test_an_empty_store_starts_without_a_map(store: Store) -> None:
    assert open_first(store, 2, open_map) is None


def test_a_map_that_never_became_good_gives_way_after_its_starts(
    store: Store, bench: Workstation
) -> None:
    use(store, install(store, bench, 1))
    store.activate(install(store, bench, 2))
    names = []
    for _ in range(3):
        opened = open_first(store, 2, open_map)
        assert opened is not None
        names.append(opened.folder.name[:2])
    assert names == ["2-", "2-", "1-"]
    assert store.linked("current") == 1


def test_the_only_map_is_started_with_again_and_again(store: Store, bench: Workstation) -> None:
    store.activate(install(store, bench, 1))
    for _ in range(4):
        assert open_first(store, 2, open_map) is not None


def test_a_map_that_does_not_open_gives_way_at_once(store: Store, bench: Workstation) -> None:
    use(store, install(store, bench, 1))
    second = install(store, bench, 2)
    use(store, second)
    (store.map_folder(second) / "manifest.json").unlink()
    opened = open_first(store, 2, open_map)
    assert opened is not None
    assert opened.folder.name.startswith("1-")
    (opened.folder / "manifest.json").unlink()
    with pytest.raises(TileError, match="none of its maps opens"):
        open_first(store, 2, open_map)


def test_a_damaged_record_stops_no_other_map(store: Store, bench: Workstation) -> None:
    first = install(store, bench, 1)
    use(store, first)
    second = install(store, bench, 2)
    store.activate(second)
    store.record(2).write_bytes(b"\0" * 40)
    (store.root / "trial.json").write_bytes(b"\0")
    opened = open_first(store, 2, open_map)
    assert opened is not None
    assert opened.folder == store.map_folder(first)
    assert store.sound_generations() == [first]
    assert install(store, bench, 3).number == 3


def test_the_same_bundle_again_mends_its_record(store: Store, bench: Workstation) -> None:
    use(store, install(store, bench, 1))
    second = install(store, bench, 2)
    record = store.record(2).read_bytes()
    store.record(2).write_bytes(record[:-30])
    (store.staging / f"{second.files[0].sha256}.part").write_bytes(b"of a power cut")
    with pytest.raises(StoreError, match="install its bundle again"):
        store.generation(2)
    with pytest.raises(BundleRefused, match="version 2 of site"):
        install(store, bench, 2, seed=7)  # another map by the same number

    assert install(store, bench, 2) == second
    assert store.record(2).read_bytes() == record
    store.record(1).write_bytes(b"")
    assert install(store, bench, 1).number == 1
    store.record(2).write_bytes(b"")
    with pytest.raises(BundleRefused, match="version 2 of site"):
        install(store, bench, 2, seed=7)  # an older one, mended, lets nothing old in


def test_refusals_of_the_opener_are_told(store: Store, bench: Workstation) -> None:
    use(store, install(store, bench, 1))

    def opener(_: Path) -> None:
        raise TileError("no")

    with pytest.raises(TileError, match="no"):
        open_first(store, 2, opener)
