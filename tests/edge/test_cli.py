# SPDX-License-Identifier: Apache-2.0
"""What `mapvo` says to wrong use, before anything heavy is loaded."""

import signal
import subprocess
import sys
from pathlib import Path

import pytest

from edge.cli.command_line import finish
from tests.world.command import assert_refused, command, mapvo

REPLAY = ("replay", "drive", "--out", "run")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((), ["COMMAND"]),
        (("fly",), ["fly", "replay", "localise"]),
        ((*REPLAY, "--frobnicate"), ["--frobnicate", "`mapvo replay"]),
        (("model", "check", "a.onnx", "--frobnicate"), ["`mapvo model check"]),
        ((*REPLAY, "--frames", "5"), ["--frames", "A:B"]),
        ((*REPLAY, "--frames", "9:3"), ["--frames", "9:3"]),
        ((*REPLAY, "--frames", "-3:"), ["--frames"]),
        ((*REPLAY, "--stride", "0"), ["--stride", "above 0"]),
        ((*REPLAY, "--real"), ["--real"]),
        (("replay", "drive"), ["--out"]),
        (("support", "--out", "site.toml"), ["site.toml", "must end in .tar.gz"]),
        (("record", "drive", "--out", "site.toml"), ["site.toml", "must end in .mcap"]),
        (("localise", "map"), ["IMAGE"]),
        (("config",), ["--defaults"]),
    ],
)
def test_wrong_use_is_one_line(arguments: tuple[str, ...], words: list[str]) -> None:
    assert_refused(mapvo(*arguments), *words, "--help")


def test_ctrl_c_is_one_line_whatever_python_makes_of_it(capfd: pytest.CaptureFixture[str]) -> None:
    class Signed:
        def __set_name__(self, owner: type, name: str) -> None:
            signal.raise_signal(signal.SIGINT)

    def work() -> int:
        return len(type("Made", (), {"signed": Signed()}).__name__)

    assert finish("mapvo", "interrupted", work) == 130
    assert capfd.readouterr().err == "mapvo: interrupted\n"


def test_what_ctrl_c_left_half_made_is_thrown_away_in_silence(
    capfd: pytest.CaptureFixture[str],
) -> None:
    class Made:
        def __init__(self) -> None:
            signal.raise_signal(signal.SIGINT)
            self.handle = 1

        def __del__(self) -> None:
            self.freed = self.handle

    def work() -> int:
        return Made().handle

    assert finish("mapvo", "interrupted", work) == 130
    assert capfd.readouterr().err == "mapvo: interrupted\n"


def test_missing_recording_is_one_line(tmp_path: Path) -> None:
    result = mapvo("replay", "none", "--out", "run", cwd=tmp_path)
    assert_refused(result, "none", "does not exist")
    assert list(tmp_path.iterdir()) == []


def test_what_is_no_fixes_is_not_replaced_by_fixes(tmp_path: Path) -> None:
    (tmp_path / "camera.toml").write_text("width = 640\n")
    result = mapvo(
        "localise", "map", "a.png", "--camera", "c.toml", "--out", "camera.toml", cwd=tmp_path
    )
    assert_refused(result, "camera.toml", "holds no fixes", "--out")
    assert (tmp_path / "camera.toml").read_text() == "width = 640\n"
    endless = mapvo("localise", "map", "a.png", "--camera", "c.toml", "--out", "/dev/full")
    assert_refused(endless, "/dev/full: is no regular file")


@pytest.mark.parametrize(
    "sources",
    [
        ["run/drive.mcap"],
        ["run"],
        ["drive", "--map", "here/map"],
        ["drive", "--config", "run/a"],
        ["run-interrupted/drive.mcap"],  # where Ctrl-C would put it
    ],
)
def test_a_run_does_not_take_the_place_of_what_it_reads(tmp_path: Path, sources: list[str]) -> None:
    (tmp_path / "run").mkdir()
    (tmp_path / "here").symlink_to("run")
    result = mapvo("replay", *sources, "--out", "run", cwd=tmp_path)
    assert_refused(result, "is or holds", "which is read", "--out")


@pytest.mark.parametrize("action", ["replay", "warm-up", "localise", "check-config"])
def test_bad_settings_are_one_line(tmp_path: Path, action: str) -> None:
    (tmp_path / "site.toml").write_text("[runtime]\nfluxcapacity = 1\n")
    arguments = {
        "replay": ["replay", ".", "--out", "run", "--config", "site.toml"],
        "warm-up": ["warm-up", "--config", "site.toml"],
        "localise": ["localise", ".", "a.png", "--camera", "c.toml", "--config", "site.toml"],
        "check-config": ["check-config", "site.toml"],
    }[action]
    result = mapvo(*arguments, cwd=tmp_path)
    assert_refused(result, "site.toml, line 2", "runtime.fluxcapacity")
    assert [file.name for file in tmp_path.iterdir()] == ["site.toml"]


def test_a_family_of_markers_that_nobody_knows_is_refused(tmp_path: Path) -> None:
    (tmp_path / "site.toml").write_text('[markers]\nfamily = "5X5_5O"\n')
    refused = mapvo("check-config", "site.toml", cwd=tmp_path)
    assert_refused(refused, "site.toml: markers.family", "'5X5_5O'", "5X5_50")


def test_defaults_are_a_good_configuration(tmp_path: Path) -> None:
    printed = mapvo("config", "--defaults")
    (tmp_path / "site.toml").write_text(printed.stdout)
    assert printed.returncode == 0
    assert mapvo("check-config", tmp_path / "site.toml").returncode == 0


def test_reader_that_leaves_early_is_no_error() -> None:
    with subprocess.Popen(
        command("config", "--defaults"), stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.close()
        assert process.stderr.read() == b""


def test_help_loads_nothing_heavy() -> None:
    code = (
        "import sys; from edge import cli\n"
        "try: cli.main(['replay', '--help'])\n"
        "except SystemExit: pass\n"
        "heavy = {'numpy', 'numba', 'cv2', 'zmq', 'scipy', 'matplotlib'} & set(sys.modules)\n"
        "sys.exit(','.join(heavy) or 0)"
    )
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False
    )
    assert result.returncode == 0, result.stderr


def test_version_is_told() -> None:
    from edge import __version__

    assert mapvo("--version").stdout == f"mapvo {__version__}\n"


def test_output_that_cannot_be_written_is_one_line() -> None:
    with Path("/dev/full").open("w") as full:
        result = subprocess.run(
            command("config", "--defaults"), stdout=full, stderr=subprocess.PIPE, check=False
        )
    assert result.returncode == 2
    assert result.stderr == b"mapvo: the output: No space left on device\n"


def test_a_name_that_no_file_can_have_is_one_line(tmp_path: Path) -> None:
    result = mapvo("replay", "n" * 300, "--out", "run", cwd=tmp_path)
    assert_refused(result, "n" * 300, "File name too long")
