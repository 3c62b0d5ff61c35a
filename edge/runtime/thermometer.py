# SPDX-License-Identifier: Apache-2.0
"""How hot the device is."""

from pathlib import Path

_PROCESSOR = ("cpu", "soc", "pkg", "core")  # how its zones are called; else all count


class Thermometer:
    """The hottest of the processor's sensors, by the kernel's thermal zones below `root`."""

    def __init__(self, root: Path = Path("/sys/class/thermal")) -> None:
        zones = [zone for zone in sorted(root.glob("thermal_zone*")) if (zone / "temp").exists()]
        of_processor = [
            zone
            for zone in zones
            if any(word in (_read(zone / "type") or "").lower() for word in _PROCESSOR)
        ]
        self._files = [zone / "temp" for zone in of_processor or zones]

    def celsius(self) -> float | None:
        """None where no sensor answers."""
        found = []
        for file in self._files:
            try:
                found.append(int(_read(file) or "") / 1000.0)
            except ValueError:
                continue
        return max(found, default=None)


def _read(file: Path) -> str | None:
    try:
        return file.read_text(encoding="ascii").strip()
    except (OSError, UnicodeDecodeError):
        return None
