# SPDX-License-Identifier: Apache-2.0
import threading
import time
from pathlib import Path

import pytest

from edge.cli import main
from edge.store.records import Outcome
from edge.store.store import Store
from maps.bundle_keys import make_key, rotate_key
from tests.edge.store.made_bundles import Workstation


class Site:
    """A device's settings and a workstation with its key."""

    def __init__(self, folder: Path) -> None:
        self.bench = Workstation(folder / "bench")
        self.store = Store(folder / "store")
        self.config = folder / "mapvo.toml"
        self.config.write_text(
            f'[tiles]\nstore = "{self.store.root}"\nkeys = "{folder}/bench/trusted"\n'
            "keep_free_mb = 0\nrehearsal_s = 30.0\n"
        )

    def tiles(self, *arguments: str | Path) -> int:
        return main(["tiles", *map(str, arguments), "--config", str(self.config)])


@pytest.fixture
def site(tmp_path: Path) -> Site:
    return Site(tmp_path)


def test_maps_are_installed_listed_checked_and_returned_from(
    site: Site, capsys: pytest.CaptureFixture[str]
) -> None:
    for command in ("list", "verify", "gc"):
        assert site.tiles(command) == 0
        assert "no map is installed" in capsys.readouterr().out
    for version in (1, 2):
        assert site.tiles("install", site.bench.bundle(version)) == 0
        generation = site.store.generation(version)
        site.store.mark_good(generation)
    said = capsys.readouterr().out
    assert "generation 2 (site hall, version 2): is used from the next start of mapvo run" in said
    assert site.tiles("verify") == site.tiles("verify", "1") == 0
    assert capsys.readouterr().out.count("are in order") == 3
    assert site.tiles("rollback") == 0
    assert site.store.linked("current") == 1
    assert site.tiles("activate", "2") == 0
    assert site.tiles("list") == 0
    assert "generation 2 (site hall, version 2): 0.2 MB [current]" in capsys.readouterr().out
    assert site.tiles("gc") == 0
    assert "generations left: 1, 2" in capsys.readouterr().out


def test_a_damaged_record_hides_no_other_map(
    site: Site, capsys: pytest.CaptureFixture[str]
) -> None:
    for version in (1, 2):
        assert site.tiles("install", site.bench.bundle(version)) == 0
    site.store.record(1).write_bytes(b"x")
    capsys.readouterr()
    for command in ("list", "verify"):
        assert site.tiles(command) == 2
        said = capsys.readouterr()
        assert said.out.startswith("generation 2 ")
        assert "generation-1.json: is damaged" in said.err


def test_what_is_wrong_is_one_line_and_status_2(
    site: Site, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    (tmp_path / "noise.mapbundle").write_bytes(b"noise" * 100)
    assert site.tiles("install", tmp_path / "noise.mapbundle") == 2
    assert site.tiles("activate", "7") == 2
    assert site.tiles("rollback") == 2
    assert main(["tiles", "list", "--config", str(tmp_path / "none.toml")]) == 2
    (tmp_path / "empty.toml").write_text("")
    assert main(["tiles", "list", "--config", str(tmp_path / "empty.toml")]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 5
    assert all(line.startswith("mapvo: ") for line in lines)
    assert "is no bundle" in lines[0]
    assert "tiles.store: is empty" in lines[4]


def test_keys_are_trusted_by_an_old_ones_word(
    site: Site, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    new = make_key(tmp_path / "new.pem")
    statement = rotate_key(site.bench.key.private, new.private, retire=False)
    assert site.tiles("trust", statement) == 0
    assert "is trusted" in capsys.readouterr().out
    assert site.tiles("install", site.bench.bundle(1, key=new)) == 0


def test_beside_a_daemon_the_map_in_use_is_returned_from_noted_or_not(site: Site) -> None:
    for version in (1, 2, 3):
        assert site.tiles("install", site.bench.bundle(version)) == 0
        if version < 3:
            site.store.mark_good(site.store.generation(version))
    in_use = site.store.generation(3)
    site.store.link("current", 2)  # a full disk kept 3 from being noted

    def obey() -> None:
        with site.store.daemon(), site.store.holding(in_use):
            begun.set()
            while (number := site.store.linked("forced")) is None and not done.is_set():
                time.sleep(0.01)
            if number is not None:
                wished.append(number)
                site.store.note_outcome(Outcome(number, ok=True, text=""))
            done.wait()

    begun, done, wished = threading.Event(), threading.Event(), list[int]()
    daemon = threading.Thread(target=obey)
    daemon.start()
    begun.wait()
    status = site.tiles("rollback")
    done.set()
    daemon.join()
    assert (status, wished) == (0, [2])


@pytest.mark.parametrize("ok", [True, False])
def test_beside_a_daemon_its_answer_is_waited_for(
    site: Site, capsys: pytest.CaptureFixture[str], ok: bool
) -> None:
    assert site.tiles("install", site.bench.bundle(1)) == 0
    path = site.bench.bundle(2)
    capsys.readouterr()

    def answer() -> None:
        with site.store.daemon():
            begun.set()
            while site.store.linked("wanted") is None:
                time.sleep(0.01)
            site.store.note_outcome(Outcome(2, ok, "as the daemon says"))
            done.wait()

    begun, done = threading.Event(), threading.Event()
    daemon = threading.Thread(target=answer)
    daemon.start()
    begun.wait()
    status = site.tiles("install", path)
    done.set()
    daemon.join()
    said = capsys.readouterr()
    assert status == (0 if ok else 2)
    assert "as the daemon says" in (said.out if ok else said.err)
    assert site.store.linked("current") == 1
