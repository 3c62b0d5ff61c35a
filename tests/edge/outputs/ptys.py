# SPDX-License-Identifier: Apache-2.0
"""Pseudo terminals as serial devices that can be unplugged and plugged in again."""

import os
import select
import time
import tty
from pathlib import Path

PATIENCE_S = 60.0


class PluggableDevice:
    """A device name that leads to a pseudo terminal while it is plugged in."""

    def __init__(self, folder: Path) -> None:
        self.path = folder / "serial-by-id"
        self._master = -1

    def plug(self) -> None:
        """A new terminal behind the same name, as after a replug."""
        self._master, slave = os.openpty()
        tty.setraw(slave)
        self.path.symlink_to(os.ttyname(slave))
        os.close(slave)
        os.set_blocking(self._master, False)

    def unplug(self) -> None:
        """The terminal hangs up and its name is gone."""
        os.close(self._master)
        self._master = -1
        self.path.unlink()

    def read(self, wait_s: float = 0.0) -> bytes:
        """What has come so far; waits for the first byte up to `wait_s`."""
        data = b""
        while select.select([self._master], [], [], 0.0 if data else wait_s)[0]:
            try:
                chunk = os.read(self._master, 65536)
            except OSError:  # the other side is closed
                break
            if not chunk:
                break
            data += chunk
        return data

    def expect(self, wanted: bytes) -> None:
        """Read, in however many pieces it comes, up to `wanted`, which must be the end."""
        data, until_s = b"", time.monotonic() + PATIENCE_S
        while len(data) < len(wanted) or not data.endswith(wanted):
            assert time.monotonic() < until_s, (
                f"it never came; {len(data)} bytes did: {data[-80:]!r}"
            )
            data += self.read(0.1)

    def close(self) -> None:
        """Unplug, if it still is."""
        if self._master >= 0:
            self.unplug()
