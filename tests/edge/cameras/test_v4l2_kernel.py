# SPDX-License-Identifier: Apache-2.0
"""The seam's real side, on files and terminals: there is no video device to count on."""

import ctypes
import os
import select
import signal
import termios
import time
from pathlib import Path

import pytest

from edge.cameras.v4l2_kernel import LinuxKernel
from edge.cameras.v4l2_stream import VideoStream
from edge.errors import CameraLost

KERNEL = LinuxKernel()
PATIENCE_S = 60.0


def test_what_is_no_video_device_is_said() -> None:
    before = len(list(Path("/proc/self/fd").iterdir()))
    with pytest.raises(CameraLost, match=r"/dev/null: .*: it is no video device"):
        VideoStream(KERNEL, "/dev/null")
    with pytest.raises(CameraLost, match="it is not plugged in"):
        VideoStream(KERNEL, "/dev/video-that-is-not-there")
    assert len(list(Path("/proc/self/fd").iterdir())) <= before


def test_an_answer_comes_back_in_the_argument_and_polling_sees_data() -> None:
    master, slave = os.openpty()
    try:
        began_s = time.monotonic()
        assert KERNEL.poll(master, 0.05) == 0
        assert time.monotonic() - began_s >= 0.04
        os.write(slave, b"abc")
        assert KERNEL.poll(master, PATIENCE_S) & select.POLLIN
        waiting = ctypes.c_int(0)
        KERNEL.ioctl(master, termios.FIONREAD, waiting)
        assert waiting.value == 3
    finally:
        os.close(slave)
        assert KERNEL.poll(master, PATIENCE_S) & select.POLLHUP
        os.close(master)


def test_a_signal_does_not_end_a_wait() -> None:
    heard: list[int] = []
    before = signal.signal(signal.SIGALRM, lambda number, frame: heard.append(number))
    read, write = os.pipe()
    try:
        signal.setitimer(signal.ITIMER_REAL, 0.02)
        began_s = time.monotonic()
        assert KERNEL.poll(read, 0.1) == 0
        assert time.monotonic() - began_s >= 0.09
        assert heard
    finally:
        signal.signal(signal.SIGALRM, before)
        os.close(read)
        os.close(write)


def test_shared_memory_is_what_the_other_side_wrote(tmp_path: Path) -> None:
    path = tmp_path / "memory"
    path.write_bytes(4096 * b"a" + 100 * b"b" + 3996 * b"c")
    fd = KERNEL.open(str(path))
    memory = KERNEL.mmap(fd, 100, 4096)
    KERNEL.close(fd)
    assert memory[:] == 100 * b"b"
    memory.close()


def test_its_clock_is_the_monotonic_one() -> None:
    assert abs(KERNEL.monotonic_ns() - time.clock_gettime_ns(time.CLOCK_MONOTONIC)) < 10**9
