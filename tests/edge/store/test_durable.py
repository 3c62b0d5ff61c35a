# SPDX-License-Identifier: Apache-2.0
import stat
from collections.abc import Iterator
from pathlib import Path

import pytest

from edge.store import durable


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def failing() -> Iterator[bytes]:
    yield b"half"
    raise OSError("the stick is gone")


def test_a_write_that_fails_leaves_nothing_behind(tmp_path: Path) -> None:
    with pytest.raises(OSError, match="gone"):
        durable.write_new(tmp_path / "new", failing())
    assert names(tmp_path) == []


def test_a_new_file_never_replaces_another(tmp_path: Path) -> None:
    (tmp_path / "there").write_text("old")
    with pytest.raises(FileExistsError):
        durable.write_new(tmp_path / "there", [b"new"])
    assert (tmp_path / "there").read_text() == "old"


def test_whole_files_replace_others_with_their_own_rights(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_text("old")
    durable.write_whole(path, b"new", 0o600)
    assert path.read_bytes() == b"new"
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert names(tmp_path) == ["file"]


def test_a_link_in_a_files_place_is_replaced_not_followed(tmp_path: Path) -> None:
    (tmp_path / "precious").write_text("keep")
    (tmp_path / "file").symlink_to("precious")
    durable.write_whole(tmp_path / "file", b"new")
    assert (tmp_path / "precious").read_text() == "keep"
    assert not (tmp_path / "file").is_symlink()


def test_links_lead_elsewhere_at_once(tmp_path: Path) -> None:
    for target in ("a", "b"):
        durable.point(tmp_path / "link", target)
        assert (tmp_path / "link").readlink() == Path(target)
    assert names(tmp_path) == ["link"]


@pytest.mark.parametrize("exchange", [True, False], ids=["at once", "in two steps"])
def test_folders_are_replaced_whole(
    tmp_path: Path, exchange: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not exchange:  # as on file systems that cannot
        monkeypatch.setattr(durable, "_exchange", lambda *_: False)
    for content in ("first", "second"):
        partial = tmp_path / ".partial"
        partial.mkdir()
        (partial / content).touch()
        durable.replace_folder(partial, tmp_path / "folder")
        assert names(tmp_path / "folder") == [content]
        assert names(tmp_path) == ["folder"]


def test_folders_are_made_with_those_above_them(tmp_path: Path) -> None:
    durable.make_folder(tmp_path / "a" / "b")
    durable.make_folder(tmp_path / "a" / "b")
    assert (tmp_path / "a" / "b").is_dir()
