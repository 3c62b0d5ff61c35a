# SPDX-License-Identifier: Apache-2.0
from pathlib import Path

import msgspec
import pytest

from edge.config.loader import load_struct
from edge.config.printer import to_toml
from edge.config.serial import SerialConfig
from edge.errors import ConfigError


def _load(folder: Path, text: str) -> SerialConfig:
    path = folder / "serial.toml"
    path.write_text(text)
    return load_struct(path, SerialConfig)


def test_defaults_fit_the_line() -> None:
    assert SerialConfig().device == ""


def test_odometry_at_30_hz_and_57600_baud_is_refused_with_the_sum(tmp_path: Path) -> None:
    with pytest.raises(ConfigError) as error:
        _load(tmp_path, "baud = 57600")
    message = str(error.value)
    assert "\n" not in message
    assert "ODOMETRY 245 bytes x 30 Hz + HEARTBEAT 21 bytes x 1 Hz" in message
    assert "= 7437 bytes/s" in message
    assert "57600 baud carries 5760 bytes/s, 80% of it usable is 4608" in message
    assert "baud to 115200 or more or rate_hz to 18 or less" in message


def test_the_cures_that_are_named_cure(tmp_path: Path) -> None:
    assert _load(tmp_path, "baud = 115200").baud == 115200
    assert _load(tmp_path, "baud = 57600\nrate_hz = 18").rate_hz == 18
    with pytest.raises(ConfigError):
        _load(tmp_path, "baud = 57600\nrate_hz = 19")


def test_the_smaller_message_fits_where_the_larger_does_not(tmp_path: Path) -> None:
    assert _load(tmp_path, 'baud = 57600\npreset = "ardupilot"').preset == "ardupilot"


@pytest.mark.parametrize("protocol", ["binary", "ascii"])
def test_other_protocols_have_a_budget_too(tmp_path: Path, protocol: str) -> None:
    with pytest.raises(ConfigError, match="9600 baud carries 960 bytes/s"):
        _load(tmp_path, f'baud = 9600\nprotocol = "{protocol}"')


def test_a_hopeless_line_says_so_without_an_impossible_cure(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"set baud to 3000000 or more; "):
        _load(tmp_path, "baud = 1200\nrate_hz = 700")


@pytest.mark.parametrize(
    ("row", "problem"),
    [
        ("[0.0, 0.0, 2.0, 0.0]", "unit length"),
        ("[0.0, 0.0, -1.0, 0.0]", "mirrors"),
        ("[0.0, 0.0, nan, 0.0]", "no finite number"),
    ],
)
def test_a_transform_that_is_none_is_refused(tmp_path: Path, row: str, problem: str) -> None:
    rows = f"[{row}, [1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]"
    with pytest.raises(ConfigError, match=problem):
        _load(tmp_path, f"T_body_cam = {rows}")


def test_another_last_row_is_refused(tmp_path: Path) -> None:
    rows = "[[0.0, 0.0, 1.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.1, 0.0, 0.0, 1]]"
    with pytest.raises(ConfigError, match="last row"):
        _load(tmp_path, f"T_body_cam = {rows}")


def test_printed_defaults_read_back(tmp_path: Path) -> None:
    class Holder(msgspec.Struct, frozen=True):
        """Holds it, as a whole configuration does."""

        serial: SerialConfig = SerialConfig()

    path = tmp_path / "all.toml"
    path.write_text(to_toml(Holder()))
    assert load_struct(path, Holder) == Holder()
