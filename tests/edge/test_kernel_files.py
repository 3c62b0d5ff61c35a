# SPDX-License-Identifier: Apache-2.0
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from numba.core import caching

from edge.kernel_files import distrust

KEY = ("float64", "x86_64")
DATA = {"code": bytes(range(256)) * 20}


@pytest.fixture
def files(tmp_path: Path) -> Any:
    """Of one kernel, with one compiled form of it."""
    distrust()
    files = caching.IndexDataCacheFile(str(tmp_path), "kernel-1.py311", ("stamp", 1))
    files.save(KEY, DATA)
    return files


DAMAGES: dict[str, Callable[[bytes], bytes]] = {
    "empty": lambda _: b"",
    "cut": lambda whole: whole[: len(whole) // 2],
    "zeros": lambda whole: bytes(len(whole)),
    "half zeros": lambda whole: whole[: len(whole) // 2] + bytes(len(whole) - len(whole) // 2),
    "a bit": lambda whole: whole[:-9] + bytes([whole[-9] ^ 1]) + whole[-8:],
}


@pytest.mark.parametrize("damage", DAMAGES.values(), ids=DAMAGES)
@pytest.mark.parametrize("ending", ["nbi", "nbc"])
def test_a_damaged_file_counts_as_missing_and_is_written_anew(
    files: Any, tmp_path: Path, ending: str, damage: Callable[[bytes], bytes]
) -> None:
    assert files.load(KEY) == DATA
    (path,) = tmp_path.glob(f"*.{ending}")
    path.write_bytes(damage(path.read_bytes()))
    assert files.load(KEY) is None
    files.save(KEY, DATA)
    assert files.load(KEY) == DATA


def test_what_an_edited_source_or_another_numba_left_is_not_used(
    files: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    edited = caching.IndexDataCacheFile(str(tmp_path), "kernel-1.py311", ("stamp", 2))
    assert edited.load(KEY) is None
    monkeypatch.setattr("edge.kernel_files._VERSION", 17)
    assert files.load(KEY) is None


def test_a_disk_that_takes_nothing_stops_nobody(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    distrust()
    files = caching.IndexDataCacheFile(str(tmp_path / "none"), "kernel-1.py311", ("stamp", 1))
    files.save(KEY, DATA)
    assert "event=kernel_not_kept" in caplog.text
    assert files.load(KEY) is None


def test_numba_is_as_expected(caplog: pytest.LogCaptureFixture) -> None:
    distrust()
    distrust()
    assert "numba_unknown" not in caplog.text
    assert len(caching.IndexDataCacheFile.__mro__) == 3
