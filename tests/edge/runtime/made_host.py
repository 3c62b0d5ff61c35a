# SPDX-License-Identifier: Apache-2.0
"""A machine's /sys, /proc and /dev as files, and what the doctor finds in them."""

from pathlib import Path

import msgspec

from edge.config import Config
from edge.runtime.doctor import examine, to_lines
from edge.runtime.doctor_host import Account, Finding, Grade, Host
from tests.edge.cameras.device_tree import MadeTree

ROOMY = 10**12


class MadeHost:
    """A healthy board with one camera; tests break what they are about."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.tree = MadeTree(root)
        self.host = Host(root, Account(uid=4321, groups=frozenset()))
        self.write("/proc/meminfo", "MemTotal: 4000000 kB\nMemAvailable: 3000000 kB\n")
        for cpu in range(4):
            self.write(f"/sys/devices/system/cpu/cpu{cpu}/cpufreq/scaling_governor", "performance")
        self.write("/sys/class/thermal/thermal_zone0/type", "cpu-thermal")
        self.write("/sys/class/thermal/thermal_zone0/temp", "45000")
        self.write("/run/systemd/timesync/synchronized", "")
        self.write("/sys/class/hwmon/hwmon1/name", "rpi_volt")
        self.write("/sys/class/hwmon/hwmon1/in0_lcrit_alarm", "0")

    def write(self, name: str, text: str, mode: int = 0o644) -> Path:
        path = self.root / name.lstrip("/")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
        path.chmod(mode)
        return path

    def plug_camera(self, serial: str = "A1", speed: str = "480", mode: int = 0o666) -> str:
        """Plug a USB camera in; returns the name that settings call it by."""
        self.tree.plug("1.2", 0, serial)
        (self.tree.sys / "devices" / "usb-1.2" / "speed").write_text(speed)
        (self.tree.dev / "video0").chmod(mode)
        return f"/dev/v4l/by-path/{self.tree.socket('1.2').name}"


def look(
    made: MadeHost, settings: dict[str, object] | None = None, room: int = ROOMY
) -> list[Finding]:
    """All that the doctor finds on the machine with these settings."""
    config = msgspec.convert(settings or {}, Config)
    return examine(config, made.host, room=lambda _: room)


def worst(findings: list[Finding], subject: str) -> Finding:
    """The worst finding about a subject."""
    order = [Grade.GOOD, Grade.DOUBTFUL, Grade.BAD]
    about = [finding for finding in findings if finding.subject == subject]
    assert about, to_lines(findings)
    return max(about, key=lambda finding: order.index(finding.grade))
