# SPDX-License-Identifier: Apache-2.0
from pathlib import Path

from edge.runtime.thermometer import Thermometer


def zone(root: Path, number: int, kind: str, millidegrees: str) -> Path:
    folder = root / f"thermal_zone{number}"
    folder.mkdir()
    (folder / "type").write_text(kind + "\n")
    (folder / "temp").write_text(millidegrees + "\n")
    return folder


def test_hottest_of_the_processor_counts(tmp_path: Path) -> None:
    zone(tmp_path, 0, "cpu-thermal", "61234")
    zone(tmp_path, 1, "soc_max", "65000")
    zone(tmp_path, 2, "battery", "90000")
    assert Thermometer(tmp_path).celsius() == 65.0


def test_without_processor_zones_all_count(tmp_path: Path) -> None:
    zone(tmp_path, 0, "acpitz", "41000")
    assert Thermometer(tmp_path).celsius() == 41.0


def test_sensor_that_fails_is_passed_over(tmp_path: Path) -> None:
    gone = zone(tmp_path, 0, "cpu0", "50000")
    zone(tmp_path, 1, "cpu1", "48000")
    zone(tmp_path, 2, "cpu2", "no number")
    thermometer = Thermometer(tmp_path)
    (gone / "temp").unlink()
    assert thermometer.celsius() == 48.0


def test_without_sensors_it_is_unknown(tmp_path: Path) -> None:
    assert Thermometer(tmp_path).celsius() is None
