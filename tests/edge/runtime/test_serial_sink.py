# SPDX-License-Identifier: Apache-2.0
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from edge.config.serial import SerialConfig
from edge.outputs.binary_frames import POSE, STATUS
from edge.outputs.serial_output import make_stream
from edge.runtime.serial_sink import SerialSink
from tests.edge.outputs import reports
from tests.edge.outputs.frame_decoder import unframe
from tests.edge.outputs.ptys import PluggableDevice

PATIENCE_S = 60.0


@pytest.fixture
def device(tmp_path: Path) -> Iterator[PluggableDevice]:
    device = PluggableDevice(tmp_path)
    yield device
    device.close()


@pytest.fixture
def sink(device: PluggableDevice) -> Iterator[SerialSink]:
    config = SerialConfig(device=str(device.path), protocol="binary", rate_hz=900.0)
    stream = make_stream(config, metric=True, T_local_map=None, map_name="hall")
    sink = SerialSink(config, stream)
    yield sink
    sink.close()


def _read_kinds(device: PluggableDevice, kind: int, within_s: float = PATIENCE_S) -> list[int]:
    """Types of the frames that come until one is of `kind`."""
    data, until_s = b"", time.monotonic() + within_s
    kinds: list[int] = []
    while kind not in kinds and time.monotonic() < until_s:
        data += device.read(0.1)
        payloads = [unframe(piece) for piece in data.split(b"\0")[:-1]]
        kinds = [payload[0] for payload in payloads if payload is not None]
    return kinds


def test_poses_and_a_status_without_frames_arrive(
    device: PluggableDevice, sink: SerialSink
) -> None:
    device.plug()
    assert STATUS in _read_kinds(device, STATUS)
    sink.write(reports.report(0))
    assert POSE in _read_kinds(device, POSE)


@pytest.mark.slow
def test_a_cable_pulled_and_put_back_gives_poses_again(
    device: PluggableDevice, sink: SerialSink
) -> None:
    for _ in range(2):
        device.plug()
        kinds: list[int] = []
        until_s = time.monotonic() + PATIENCE_S  # how soon it is, test_serial_port.py says
        index = 0
        while POSE not in kinds and time.monotonic() < until_s:
            sink.write(reports.report(index))
            kinds = _read_kinds(device, POSE, 0.03)
            index += 1
        assert POSE in kinds
        device.unplug()


def test_a_line_that_nobody_reads_never_delays_the_writer(
    device: PluggableDevice, sink: SerialSink
) -> None:
    device.plug()
    assert STATUS in _read_kinds(device, STATUS)
    some = [reports.report(index) for index in range(10)]
    for index in range(3000):  # who waited for the line would do so for ever
        sink.write(some[index % 10])
    assert sink.dropped > 0


def test_closing_ends_the_thread_and_frees_the_device(
    device: PluggableDevice, sink: SerialSink
) -> None:
    device.plug()
    assert STATUS in _read_kinds(device, STATUS)
    sink.close()
    assert device.read() == b""
    sent = sink.sent
    sink.write(reports.report(0))
    time.sleep(0.05)
    assert sink.sent == sent
