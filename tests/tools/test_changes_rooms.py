# SPDX-License-Identifier: Apache-2.0
from pathlib import Path

from tools.bench.changes_rooms import drop_stale


def test_drives_of_another_simulator_are_dropped_and_others_kept(tmp_path: Path) -> None:
    folder = tmp_path / "drives"
    image = folder / "map" / "000000.jpg"
    drop_stale(folder)
    image.parent.mkdir()
    image.touch()

    drop_stale(folder)
    assert image.exists()

    (folder / "simulator.sha256").write_text("of another one")
    drop_stale(folder)
    assert not image.exists()

    image.parent.mkdir()
    image.touch()
    (folder / "simulator.sha256").unlink()
    drop_stale(folder)
    assert not image.exists()
