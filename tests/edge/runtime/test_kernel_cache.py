# SPDX-License-Identifier: Apache-2.0
import os
from pathlib import Path

import pytest

from edge.runtime.kernel_cache import KEPT_CACHES, sources_hash, use_kernel_cache

KERNEL_FILE = "from edge.numbers import HALF\n\n@kernel\ndef f(x):\n    return HALF * x\n"


@pytest.fixture
def root(tmp_path: Path) -> Path:
    (tmp_path / "edge").mkdir()
    (tmp_path / "edge" / "kernels.py").write_text(KERNEL_FILE)
    (tmp_path / "edge" / "numbers.py").write_text("HALF = 0.5\n")
    (tmp_path / "edge" / "cli.py").write_text("import argparse\n")
    return tmp_path


@pytest.mark.parametrize(
    ("edited", "changes"), [("kernels.py", True), ("numbers.py", True), ("cli.py", False)]
)
def test_hash_follows_what_kernels_are_made_of(root: Path, edited: str, changes: bool) -> None:
    before = sources_hash(root)
    with (root / "edge" / edited).open("a") as file:
        file.write("A = 1\n")
    assert (sources_hash(root) != before) is changes


def test_given_folder_is_kept(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "mine"))
    assert use_kernel_cache(tmp_path / "other") == tmp_path / "mine"
    assert not (tmp_path / "other").exists()


def test_bounds_checked_kernels_live_apart(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    folders = set()
    for bounds in ("0", "1"):
        monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
        monkeypatch.setenv("NUMBA_BOUNDSCHECK", bounds)
        folders.add(use_kernel_cache(tmp_path))
    assert len(folders) == 2


def test_old_folders_go(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    for age_days in range(2, 12):
        folder = tmp_path / f"old{age_days}"
        folder.mkdir()
        stamp = tmp_path.stat().st_mtime - 86_400 * age_days
        os.utime(folder, (stamp, stamp))
    used = use_kernel_cache(tmp_path)
    assert len(list(tmp_path.iterdir())) == KEPT_CACHES
    assert used.is_dir()


def test_unwritable_place_is_no_obstacle(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    blocker = tmp_path / "file"
    blocker.write_text("")
    folder = use_kernel_cache(blocker)
    assert folder.is_dir()
    folder.rmdir()
    assert "set NUMBA_CACHE_DIR" in caplog.text
