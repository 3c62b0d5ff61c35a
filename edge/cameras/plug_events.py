# SPDX-License-Identifier: Apache-2.0
"""Hears of devices that are plugged in, so that a lost camera is looked for at once.

A hint only: who waits looks again after its time in any case, as events get lost.
"""

import contextlib
import logging
import os
import select
import socket
import time
from collections.abc import Callable

log = logging.getLogger(__name__)

# Of <linux/netlink.h>; Python's socket module lacks the first.
_NETLINK_KOBJECT_UEVENT = 15
_KERNEL_AND_UDEV = 1 | 2  # groups; udev's come when the names under /dev are there
_MAX_BYTES = 65536
_SUBSYSTEMS = (b"SUBSYSTEM=video4linux", b"SUBSYSTEM=usb\0")


def open_uevents() -> socket.socket:
    """Socket on which the kernel and udev tell of devices; OSError where it is forbidden."""
    uevents = socket.socket(
        socket.AF_NETLINK,
        socket.SOCK_DGRAM | socket.SOCK_CLOEXEC | socket.SOCK_NONBLOCK,
        _NETLINK_KOBJECT_UEVENT,
    )
    try:
        uevents.bind((0, _KERNEL_AND_UDEV))
    except OSError:
        uevents.close()
        raise
    return uevents


class PlugEvents:
    """Waits for a time, or until a camera may have been plugged in.

    Owned by one thread, but for `wake`, which any thread and signal handler may call.
    """

    def __init__(self, open_socket: Callable[[], socket.socket] = open_uevents) -> None:
        self._socket: socket.socket | None = None
        try:
            self._socket = open_socket()
        except OSError as error:  # in some containers
            log.info("event=no_plug_events: %s: cameras are looked for by time alone", error)
        self._wake_out, self._wake_in = os.pipe2(os.O_CLOEXEC | os.O_NONBLOCK)

    def wait(self, seconds: float) -> None:
        """Sleep so long at most."""
        poller = select.poll()
        poller.register(self._wake_out, select.POLLIN)
        if self._socket is not None:
            poller.register(self._socket, select.POLLIN)
        ends_ns = time.monotonic_ns() + round(seconds * 1e9)
        while (left_ns := ends_ns - time.monotonic_ns()) > 0:
            events = poller.poll(left_ns * 1e-6)
            if not events or any(fd == self._wake_out for fd, _ in events) or self._is_camera():
                return

    def wake(self) -> None:
        """End the waiting, now and from now on."""
        if (fd := self._wake_in) >= 0:
            with contextlib.suppress(BlockingIOError):  # it was woken often enough
                os.write(fd, b"!")

    def close(self) -> None:
        """Free the socket."""
        if self._socket is not None:
            self._socket.close()
        fd, self._wake_in = self._wake_in, -1  # a late signal must not write to another file
        os.close(fd)
        os.close(self._wake_out)

    def _is_camera(self) -> bool:
        """Take all events that are there; whether one is of a camera that may have come."""
        assert self._socket is not None
        found = False
        while True:
            try:
                event = self._socket.recv(_MAX_BYTES)
            except BlockingIOError:
                return found
            except OSError:  # more came than its memory holds
                return True
            is_removal = b"ACTION=remove" in event or event.startswith(b"remove@")
            found |= not is_removal and any(name in event for name in _SUBSYSTEMS)
