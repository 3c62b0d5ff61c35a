# SPDX-License-Identifier: Apache-2.0
from pathlib import Path

import pytest

from edge.runtime.supply import Supply, SupplyReport


def with_alarm(root: Path, value: str) -> Path:
    for number, name in enumerate(("cpu_thermal", "rpi_volt")):
        folder = root / f"sys/class/hwmon/hwmon{number}"
        folder.mkdir(parents=True)
        (folder / "name").write_text(name + "\n")
    (folder / "in0_lcrit_alarm").write_text(value + "\n")
    return folder


@pytest.mark.parametrize(
    ("bits", "expected"),
    [
        ("0", SupplyReport(low=False)),
        ("50005", SupplyReport(low=True, was_low=True, was_slowed=True)),
        ("10000", SupplyReport(low=False, was_low=True)),
        ("0xe0000", SupplyReport(low=False, was_slowed=True)),
    ],
)
def test_the_firmwares_report_is_read_by_its_bits(
    tmp_path: Path, bits: str, expected: SupplyReport
) -> None:
    file = tmp_path / "sys/devices/platform/soc/soc:firmware/get_throttled"
    file.parent.mkdir(parents=True)
    file.write_text(bits + "\n")
    assert Supply(tmp_path).read() == expected


@pytest.mark.parametrize("value", ["0", "1"])
def test_the_alarm_of_the_kernels_driver_is_read(tmp_path: Path, value: str) -> None:
    folder = with_alarm(tmp_path, value)
    supply = Supply(tmp_path)
    assert supply.read() == SupplyReport(low=value == "1")
    (folder / "in0_lcrit_alarm").write_text("1")
    assert supply.read() == SupplyReport(low=True)


def test_boards_that_do_not_tell_are_not_guessed(tmp_path: Path) -> None:
    assert Supply(tmp_path).read() is None
    with_alarm(tmp_path, "0")
    supply = Supply(tmp_path)
    (tmp_path / "sys/class/hwmon/hwmon1/in0_lcrit_alarm").unlink()
    assert supply.read() is None
