# SPDX-License-Identifier: Apache-2.0
import socket
import threading
import time
from collections.abc import Iterator

import pytest

from edge.cameras.plug_events import PlugEvents, open_uevents

CAMERA = b"add@/devices/usb1/video0\0ACTION=add\0SUBSYSTEM=video4linux\0DEVNAME=video0\0"
LONG_S, PATIENCE_S = 20.0, 10.0


@pytest.fixture
def pair() -> Iterator[tuple[PlugEvents, socket.socket]]:
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    ours.setblocking(False)
    events = PlugEvents(lambda: ours)
    yield events, theirs
    events.close()
    theirs.close()


def _waited_s(events: PlugEvents, seconds: float) -> float:
    began = time.monotonic()
    events.wait(seconds)
    return time.monotonic() - began


@pytest.mark.parametrize("message", [CAMERA, b"libudev\0....SUBSYSTEM=usb\0ACTION=bind\0"])
def test_a_camera_that_is_plugged_in_ends_the_waiting(
    pair: tuple[PlugEvents, socket.socket], message: bytes
) -> None:
    events, sender = pair
    sender.send(message)
    assert _waited_s(events, LONG_S) < PATIENCE_S


@pytest.mark.parametrize(
    "message",
    [
        b"add@/devices/sda\0ACTION=add\0SUBSYSTEM=block\0",
        CAMERA.replace(b"add@", b"remove@").replace(b"ACTION=add", b"ACTION=remove"),
        b"",
        b"\xff" * 3000,
    ],
)
def test_other_events_do_not(pair: tuple[PlugEvents, socket.socket], message: bytes) -> None:
    events, sender = pair
    sender.send(message)
    assert _waited_s(events, 0.1) >= 0.1


def test_waking_ends_it_now_and_later(pair: tuple[PlugEvents, socket.socket]) -> None:
    events, _ = pair
    threading.Timer(0.05, events.wake).start()
    assert _waited_s(events, LONG_S) < PATIENCE_S
    assert _waited_s(events, LONG_S) < PATIENCE_S
    for _ in range(70_000):  # more than a pipe holds
        events.wake()


def test_where_events_are_forbidden_it_waits_by_time_alone() -> None:
    def forbidden() -> socket.socket:
        raise PermissionError(1, "Operation not permitted")

    events = PlugEvents(forbidden)
    assert _waited_s(events, 0.05) >= 0.05
    events.close()
    events.wake()  # a signal that comes late does no harm


def test_the_kernels_own_socket_opens_or_says_no() -> None:
    try:
        open_uevents().close()
    except OSError:
        pytest.skip("no uevents here")
