# SPDX-License-Identifier: Apache-2.0
import shutil
from pathlib import Path

import pytest

from edge.cli import main
from edge.runtime.doctor_host import Grade
from tests.edge.runtime.made_host import MadeHost, look, worst


@pytest.fixture
def made(tmp_path: Path) -> MadeHost:
    return MadeHost(tmp_path)


@pytest.mark.parametrize(
    ("name", "text", "subject", "grade"),
    [
        ("/sys/class/thermal/thermal_zone0/temp", "73000", "temperature", Grade.DOUBTFUL),
        ("/sys/class/thermal/thermal_zone0/temp", "85000", "temperature", Grade.BAD),
        ("/sys/class/hwmon/hwmon1/in0_lcrit_alarm", "1", "supply", Grade.BAD),
        ("/proc/meminfo", "MemAvailable: 500000 kB", "memory", Grade.DOUBTFUL),
        ("/proc/meminfo", "MemAvailable: 200000 kB", "memory", Grade.BAD),
        (
            *("/sys/devices/system/cpu/cpu2/cpufreq/scaling_governor", "powersave", "governor"),
            Grade.DOUBTFUL,
        ),
        (
            *("/sys/devices/system/clocksource/clocksource0/current_clocksource", "hpet"),
            *("clock source", Grade.DOUBTFUL),
        ),
    ],
)
def test_trouble_of_the_machine_is_found(
    made: MadeHost, name: str, text: str, subject: str, grade: Grade
) -> None:
    made.write(name, text)
    assert worst(look(made), subject).grade is grade


@pytest.mark.parametrize(
    ("report", "grade"),
    [("0", Grade.GOOD), ("50005", Grade.BAD), ("50000", Grade.DOUBTFUL), ("e0000", Grade.DOUBTFUL)],
)
def test_a_raspberrys_own_report_is_read(made: MadeHost, report: str, grade: Grade) -> None:
    shutil.rmtree(made.root / "sys/class/hwmon")
    made.write("/sys/devices/platform/soc/soc:firmware/get_throttled", report)
    assert worst(look(made), "supply").grade is grade


def test_a_core_that_is_switched_off_tells_no_governor_and_hides_nothing(made: MadeHost) -> None:
    governor = made.root / "sys/devices/system/cpu/cpu3/cpufreq/scaling_governor"
    governor.unlink()
    governor.mkdir()  # as little to be read as that of such a core
    findings = look(made)
    assert worst(findings, "governor").grade is Grade.GOOD
    assert worst(findings, "disk").grade is Grade.GOOD


def test_a_clock_that_nobody_keeps_is_noticed(made: MadeHost) -> None:
    (made.root / "run/systemd/timesync/synchronized").unlink()
    assert worst(look(made), "clock").grade is Grade.DOUBTFUL
    made.write("/sys/class/rtc/rtc0/name", "rtc")
    assert worst(look(made), "clock").grade is Grade.GOOD


@pytest.mark.parametrize(
    ("room_mb", "grade"), [(50, Grade.BAD), (500, Grade.DOUBTFUL), (5000, Grade.GOOD)]
)
def test_a_disk_that_is_nearly_full_is_noticed(made: MadeHost, room_mb: int, grade: Grade) -> None:
    assert worst(look(made, room=room_mb * 10**6), "disk").grade is grade


def test_a_recorder_needs_the_room_that_it_leaves_to_others(made: MadeHost) -> None:
    settings = {"recorder": {"folder": "/rec", "min_free_mb": 800.0}}
    assert worst(look(made, settings, room=700_000_000), "recorder").grade is Grade.BAD


def test_a_check_that_fails_itself_hides_no_other(made: MadeHost) -> None:
    made.write("/proc/meminfo", "MemAvailable: nonsense")
    findings = look(made)
    assert "cannot be looked at: ValueError" in worst(findings, "system").found
    assert worst(findings, "camera").grade is Grade.DOUBTFUL


def test_the_exit_status_says_whether_it_will_work(
    made: MadeHost, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    made.write("/proc/meminfo", "MemAvailable: 100000 kB")
    assert main(["doctor", "--root", str(made.root)]) == 1
    assert "bad   memory" in capsys.readouterr().out
    config = tmp_path / "c.toml"
    config.write_text("[camera]\nsource = 3\n")
    assert main(["doctor", "--config", str(config)]) == 2
