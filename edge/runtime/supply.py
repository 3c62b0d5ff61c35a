# SPDX-License-Identifier: Apache-2.0
"""Whether the board gets the power that it needs, where it can tell: Raspberry Pis do."""

from pathlib import Path
from typing import NamedTuple

_UNDER_VOLTAGE, _SLOWED = 0x1, 0xE  # bits of the firmware's report; the same 16 higher: since boot
_SINCE_BOOT = 16


class SupplyReport(NamedTuple):
    """What the board says of its supply."""

    low: bool  # now
    was_low: bool = False  # since boot
    was_slowed: bool = False  # the processor, since boot, for heat or a low supply


class Supply:
    """Reads the report, from the files of a system below `root`."""

    def __init__(self, root: Path = Path("/")) -> None:
        self._firmware = root / "sys/devices/platform/soc/soc:firmware/get_throttled"
        names = sorted(root.glob("sys/class/hwmon/hwmon*/name"))
        alarms = [name.with_name("in0_lcrit_alarm") for name in names if _read(name) == "rpi_volt"]
        self._alarm = alarms[0] if alarms else None

    def read(self) -> SupplyReport | None:
        """None where the board does not tell."""
        text = _read(self._firmware)
        if text is not None:
            try:
                bits = int(text, 16)
            except ValueError:
                return None
            both = bits | bits >> _SINCE_BOOT
            return SupplyReport(
                bool(bits & _UNDER_VOLTAGE), bool(both & _UNDER_VOLTAGE), bool(both & _SLOWED)
            )
        alarm = None if self._alarm is None else _read(self._alarm)
        return None if alarm is None else SupplyReport(alarm == "1")


def _read(file: Path) -> str | None:
    try:
        return file.read_text(encoding="ascii").strip("\0 \n")
    except (OSError, UnicodeDecodeError):
        return None
