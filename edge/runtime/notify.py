# SPDX-License-Identifier: Apache-2.0
"""Tells systemd that we are ready and alive (sd_notify(3)); without systemd it does nothing."""

import logging
import os
import socket
from collections.abc import Mapping

log = logging.getLogger(__name__)


class Notifier:
    """Owned by the tracking thread: the watchdog is fed by nothing else."""

    def __init__(self, environment: Mapping[str, str] = os.environ) -> None:
        self._socket: socket.socket | None = None
        address = environment.get("NOTIFY_SOCKET", "")
        if address.startswith(("/", "@")):
            self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC)
            self._socket.setblocking(False)
            self._address = "\0" + address[1:] if address.startswith("@") else address
        self._interval_ns = _watchdog_ns(environment) // 2
        self._next_ns = 0

    def ready(self) -> None:
        """The daemon works."""
        self._send("READY=1")

    def stopping(self) -> None:
        """The daemon ends by itself."""
        self._send("STOPPING=1")

    def status(self, text: str) -> None:
        """One line for `systemctl status`."""
        self._send("STATUS=" + text.replace("\n", " "))

    def beat(self, now_ns: int) -> None:
        """Feed the watchdog as often as it needs; call it at every turn of the loop."""
        if self._interval_ns and now_ns >= self._next_ns:
            self._next_ns = now_ns + self._interval_ns
            self._send("WATCHDOG=1")

    def close(self) -> None:
        """Free the socket."""
        if self._socket is not None:
            self._socket.close()

    def _send(self, text: str) -> None:
        if self._socket is None:
            return
        try:
            self._socket.sendto(text.encode(), self._address)
        except OSError as error:
            log.debug("event=notify_failed %s", error)


def _watchdog_ns(environment: Mapping[str, str]) -> int:
    """The watchdog's patience; 0 where there is none, or it is another process's."""
    microseconds = environment.get("WATCHDOG_USEC", "")
    meant = environment.get("WATCHDOG_PID", str(os.getpid()))
    if not microseconds.isdigit() or meant != str(os.getpid()):
        return 0
    return int(microseconds) * 1000
