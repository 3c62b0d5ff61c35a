# SPDX-License-Identifier: Apache-2.0
from pathlib import Path

import pytest

from maps.cli import main
from tests.maps.wall_drive import write_wall_drive


def one_line(text: str) -> str:
    assert text.count("\n") == 1
    return text.rstrip("\n")


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_wall_drive(tmp_path_factory.mktemp("drives") / "wall", 4)


@pytest.fixture(scope="module")
def built(drive: Path) -> Path:
    out = drive.parent / "map"
    assert main(["build", str(drive), "--out", str(out), "--every", "1"]) == 0
    return out


def test_build_says_what_came_out(
    drive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "map"
    command = ["build", str(drive), "--out", str(out), "--frames", "0:3", "--exclude", "1"]
    assert main(command) == 0
    said = capsys.readouterr()
    assert "2 keyframes" in one_line(said.out)
    assert said.err == ""


def test_verify_prints_one_line(built: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["verify", str(built)]) == 0
    assert one_line(capsys.readouterr().out).startswith("OK: 1 tiles")


def test_inspect_prints_a_table(built: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["inspect", str(built)]) == 0
    table = dict(line.split(maxsplit=1) for line in capsys.readouterr().out.splitlines()[:1])
    assert table == {"map": str(built)}


def test_inspect_shows_sizes_counts_and_settings(
    built: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    main(["inspect", str(built)])
    said = capsys.readouterr().out
    for word in ("keyframes      4", "tile_m=40.0", "features", "kB a keyframe", "none, id"):
        assert word in said


@pytest.mark.slow
def test_inspect_draws_a_picture(
    built: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    picture = tmp_path / "map.png"
    assert main(["inspect", str(built), "--picture", str(picture)]) == 0
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert str(picture) in capsys.readouterr().out
    assert main(["inspect", str(built), "--picture", str(tmp_path / "no" / "map.png")]) == 2
    assert "map.png" in one_line(capsys.readouterr().err)


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["verify", "nowhere"], "nowhere"),
        (["inspect", "nowhere"], "nowhere"),
        (["build", "nowhere", "--out", "map"], "nowhere"),
        (["build", "{drive}", "--out", "map", "--frames", "90:99"], "90:99"),
        (["build", "{drive}", "--out", "map", "--exclude", "0,1,2,3"], "pose"),
        (["build", "{drive}", "--out", "map", "--exclude", "1,99"], "--exclude 99: its images are"),
        (["build", "{drive}", "--out", "map", "--depth", "stereo"], "right"),
        (["build", "{drive}", "--out", "/proc/map"], "/proc/map"),
    ],
)
def test_bad_input_is_one_line_and_status_two(
    drive: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    expected: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main([argument.format(drive=drive) for argument in arguments]) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert expected in one_line(said.err)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "arguments",
    [
        [],
        ["fly"],
        ["build", "drive"],
        ["build", "drive", "--out", "map", "--frames", "5"],
        ["build", "drive", "--out", "map", "--frames", "-3:5"],
        ["build", "drive", "--out", "map", "--every", "0"],
        ["build", "drive", "--out", "map", "--workers", "-1"],
        ["build", "drive", "--out", "map", "--exclude", "1;2"],
        ["build", "drive", "--out", "map", "--tile-m", "nan"],
        ["build", "drive", "--out", "map", "--depth", "guessed"],
        ["bundle", "map", "--key", "site.pem", "--out", "site.pem"],
    ],
)
def test_wrong_use_is_status_two(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stopped:
        main(arguments)
    assert stopped.value.code == 2
    assert one_line(capsys.readouterr().err).startswith("mapvo-map")
