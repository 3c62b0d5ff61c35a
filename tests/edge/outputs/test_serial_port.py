# SPDX-License-Identifier: Apache-2.0
import logging
import termios
from collections.abc import Iterator
from pathlib import Path

import pytest
import serial

from edge.outputs.serial_port import SerialPort
from tests.edge.outputs.ptys import PluggableDevice

MS = 1_000_000


@pytest.fixture
def device(tmp_path: Path) -> Iterator[PluggableDevice]:
    device = PluggableDevice(tmp_path)
    yield device
    device.close()


@pytest.fixture
def port(device: PluggableDevice) -> Iterator[SerialPort]:
    port = SerialPort(str(device.path), 115200)
    yield port
    port.close()


def test_messages_arrive_whole_and_in_order(device: PluggableDevice, port: SerialPort) -> None:
    device.plug()
    assert port.write(b"one\n", 0)
    assert port.write(b"two\n\xff\x11\x13\0", MS)  # nothing is taken for flow control
    device.expect(b"one\ntwo\n\xff\x11\x13\0")
    assert (port.sent, port.dropped) == (2, 0)


def test_the_line_is_raw_and_has_its_rate(device: PluggableDevice, port: SerialPort) -> None:
    device.plug()
    port.write(b"x", 0)
    with device.path.open("rb", buffering=0) as line:
        attributes = termios.tcgetattr(line.fileno())
    assert attributes[5] == termios.B115200
    assert not attributes[1] & termios.OPOST


def test_a_device_that_comes_late_is_opened_then(
    device: PluggableDevice, port: SerialPort, caplog: pytest.LogCaptureFixture
) -> None:
    for step in range(100):
        assert not port.write(b"early", step * 10 * MS)
    assert [record.levelno for record in caplog.records] == [logging.WARNING]
    assert "plug it in" in caplog.text
    device.plug()
    assert port.write(b"", 3_000 * MS)
    assert port.write(b"late", 3_001 * MS)
    device.expect(b"late")
    assert port.dropped == 100


def test_a_cable_pulled_and_put_back_twice_works_again(
    device: PluggableDevice, port: SerialPort
) -> None:
    now_ns = 0
    for turn in range(3):
        device.plug()
        before_ns = now_ns
        while not port.write(b"turn %d" % turn, now_ns):
            now_ns += 50 * MS
            assert now_ns - before_ns <= 3_000 * MS
        device.expect(b"turn %d" % turn)
        device.unplug()
        assert not port.write(b"gone", now_ns)
        assert not port.is_open
        for _ in range(20):  # it stays away for 2 s
            now_ns += 100 * MS
            assert not port.write(b"gone", now_ns)
    assert port.sent == 3


def _open_files() -> int:
    return len(list(Path("/proc/self/fd").iterdir()))


def test_replugging_leaks_no_descriptors(device: PluggableDevice, port: SerialPort) -> None:
    def turn(now_ns: int) -> None:
        device.plug()
        assert port.write(b"x", now_ns)
        device.unplug()
        assert not port.write(b"x", now_ns)

    turn(0)
    before = _open_files()
    for index in range(1, 10):
        turn(index * 10_000 * MS)
    assert _open_files() <= before


def test_a_reader_that_stops_never_stalls_the_writer_and_then_gets_the_newest(
    device: PluggableDevice, port: SerialPort, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    device.plug()
    message = b"%06d" + 240 * b"." + b"\n"
    now_ns = 0
    for index in range(3000):  # a write that waits would do so for ever
        port.write(message % index, now_ns)
        now_ns += 33 * MS
    assert port.dropped > 500
    assert caplog.text.count("event=serial_stalled") == 1
    numbers = [int(line[:6]) for line in device.read().split(b"\n") if len(line) == 246]
    # Old are only those on the reader's own side (4 kB), not what the line held (64 kB).
    assert sum(number < 2900 for number in numbers) < 20
    for index in range(3000, 3500):
        assert port.write(message % index, now_ns)
        device.expect(message % index)
        now_ns += 33 * MS
    assert caplog.text.count("event=serial_resumed") == 1


def test_a_message_cut_by_a_full_line_is_finished_before_the_next(
    device: PluggableDevice, port: SerialPort
) -> None:
    device.plug()
    message = b"<" + 997 * b"." + b">\n"
    now_ns = 0
    while port.write(message, now_ns):
        now_ns += MS
    received, sent = b"", False
    while not received.endswith(b"<last>\n"):
        received += device.read(0.01)
        sent = sent or port.write(b"<last>\n", now_ns)
    assert set(received.split(b"\n")) == {message[:-1], b"<last>", b""}


def test_a_device_that_another_program_holds_is_named(
    device: PluggableDevice, port: SerialPort, caplog: pytest.LogCaptureFixture
) -> None:
    device.plug()
    with serial.Serial(str(device.path), exclusive=True):
        assert not port.write(b"x", 0)
    assert "end the other program" in caplog.text


def test_what_is_no_serial_device_is_said(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = tmp_path / "file"
    path.write_bytes(b"")
    port = SerialPort(str(path), 115200)
    assert not port.write(b"x", 0)
    assert "must be a serial device" in caplog.text
    assert path.read_bytes() == b""


def test_closing_with_a_full_line_is_quick(device: PluggableDevice, port: SerialPort) -> None:
    device.plug()
    while port.write(1000 * b"x", 0):
        pass
    port.close()  # else this waits until somebody reads
