# SPDX-License-Identifier: Apache-2.0
import os
import socket
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

from edge.runtime.notify import Notifier

SECOND_NS = 1_000_000_000


@pytest.fixture
def systemd(tmp_path: Path) -> Iterator[socket.socket]:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listener:
        listener.bind(str(tmp_path / "notify"))
        listener.setblocking(False)
        yield listener


def heard(systemd: socket.socket) -> list[str]:
    lines = []
    try:
        while True:
            lines.append(systemd.recv(4096).decode())
    except BlockingIOError:
        return lines


def environment(systemd: socket.socket, **more: str) -> dict[str, str]:
    return {"NOTIFY_SOCKET": systemd.getsockname(), **more}


def test_states_are_told(systemd: socket.socket) -> None:
    with closing(Notifier(environment(systemd))) as notifier:
        notifier.ready()
        notifier.status("two\nlines")
        notifier.beat(0)  # no watchdog asked for
        notifier.stopping()
    assert heard(systemd) == ["READY=1", "STATUS=two lines", "STOPPING=1"]


def test_watchdog_is_fed_twice_in_its_patience(systemd: socket.socket) -> None:
    asked = environment(systemd, WATCHDOG_USEC="2000000", WATCHDOG_PID=str(os.getpid()))
    with closing(Notifier(asked)) as notifier:
        for tenth in range(50):
            notifier.beat(tenth * SECOND_NS // 10)
    assert heard(systemd) == ["WATCHDOG=1"] * 5


def test_watchdog_of_another_process_is_not_fed(systemd: socket.socket) -> None:
    asked = environment(systemd, WATCHDOG_USEC="2000000", WATCHDOG_PID="1")
    with closing(Notifier(asked)) as notifier:
        notifier.beat(0)
    assert heard(systemd) == []


def test_without_systemd_nothing_happens() -> None:
    with closing(Notifier({})) as notifier:
        notifier.ready()
        notifier.beat(0)


def test_socket_that_is_gone_or_full_stops_nobody(systemd: socket.socket) -> None:
    with closing(Notifier(environment(systemd))) as notifier:
        for _ in range(2000):  # more than the socket holds; nobody reads
            notifier.status("x" * 200)
    with closing(Notifier({"NOTIFY_SOCKET": "/nowhere/notify"})) as notifier:
        notifier.ready()


def test_abstract_socket_is_found() -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listener:
        listener.bind("")  # the kernel chooses an abstract name
        name = listener.getsockname()
        with closing(Notifier({"NOTIFY_SOCKET": "@" + name[1:].decode()})) as notifier:
            notifier.ready()
        assert listener.recv(100) == b"READY=1"
