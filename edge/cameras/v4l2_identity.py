# SPDX-License-Identifier: Apache-2.0
"""Which camera is which: by the socket that it is in and by its serial number."""

from dataclasses import dataclass
from pathlib import Path

from edge.errors import CameraLost

_FIRST_NODE = "video-index0"  # the others of a camera give metadata


@dataclass(frozen=True, slots=True)
class Identity:
    """A camera that is plugged in; a calibration is bound to it."""

    node: str  # /dev/videoN, another one after each replug
    by_path: str  # its socket, as the name under /dev/v4l/by-path says; empty where udev has none
    serial: str  # empty where the device has none

    @property
    def key(self) -> str:
        """What a calibration names it by: the serial number, else the socket."""
        return f"serial:{self.serial}" if self.serial else f"path:{self.by_path or self.node}"


@dataclass(frozen=True, slots=True)
class DeviceTree:
    """Where the system lists its cameras; tests give folders of their own."""

    dev: Path = Path("/dev")
    sys: Path = Path("/sys")

    def find(self, device: str, serial: str) -> Identity:
        """The camera named by `device` (a path, or empty) and `serial` (or empty).

        In its socket another camera is never taken for it; with a serial number it is found
        in any socket. CameraLost says what is there instead.
        """
        if device and Path(device).exists():
            found = self._identify(Path(device))
            if not serial or found.serial == serial:
                return found
            there = f"a camera with serial {found.serial or '(none)'} is in the place of {serial}"
        else:
            there = f"{device or 'camera'} is not plugged in"
        others = [entry for entry in self.all() if serial and entry.serial == serial]
        if len(others) == 1:
            return others[0]
        if others:
            there = f"{len(others)} cameras have serial {serial}: name their sockets"
        raise CameraLost(f"{device or serial}: {there}")

    def all(self) -> list[Identity]:
        """Every camera that is plugged in, by its first node."""
        links = sorted((self.dev / "v4l" / "by-path").glob(f"*{_FIRST_NODE}"))
        found: dict[str, Identity] = {}
        for link in links:  # udev may give one device two names
            if link.exists():
                identity = self._identify(link)
                found.setdefault(identity.node, identity)
        return list(found.values())

    def _identify(self, path: Path) -> Identity:
        node = path.resolve()
        by_path = path.name if path.parent.name == "by-path" else self._name_of(node)
        return Identity(str(node), by_path, self._serial(node.name))

    def _name_of(self, node: Path) -> str:
        links = sorted((self.dev / "v4l" / "by-path").glob("*"))
        return next((link.name for link in links if link.resolve() == node), "")

    def _serial(self, name: str) -> str:
        """Serial number of the USB device that the node's interface belongs to."""
        interface = self.sys / "class" / "video4linux" / name / "device"
        try:
            return (interface.resolve().parent / "serial").read_text().strip()
        except (OSError, UnicodeDecodeError):
            return ""
