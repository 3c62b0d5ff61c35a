# SPDX-License-Identifier: Apache-2.0
"""Folders that list cameras as /dev and /sys do."""

from pathlib import Path

from edge.cameras.v4l2_identity import DeviceTree


class MadeTree:
    """Cameras in sockets."""

    def __init__(self, root: Path) -> None:
        self.dev, self.sys = root / "dev", root / "sys"
        (self.dev / "v4l" / "by-path").mkdir(parents=True)
        (self.sys / "class" / "video4linux").mkdir(parents=True)
        self.tree = DeviceTree(self.dev, self.sys)

    def socket(self, name: str) -> Path:
        """Where udev puts the name of a socket's first node."""
        return self.dev / "v4l" / "by-path" / f"platform-usb-0:{name}:1.0-video-index0"

    def plug(self, socket: str, number: int, serial: str = "") -> None:
        """A USB camera with two nodes, as they all have."""
        usb = self.sys / "devices" / f"usb-{socket}"
        interface = usb / f"{socket}:1.0"
        for offset in (0, 1):
            node = self.dev / f"video{number + offset}"
            node.touch()
            entry = interface / "video4linux" / node.name
            entry.mkdir(parents=True)
            (entry / "device").symlink_to(interface)
            (self.sys / "class" / "video4linux" / node.name).symlink_to(entry)
            link = self.socket(socket)
            link = link.with_name(link.name.replace("index0", f"index{offset}"))
            link.symlink_to(node)
        if serial:
            (usb / "serial").write_text(f"{serial}\n")
