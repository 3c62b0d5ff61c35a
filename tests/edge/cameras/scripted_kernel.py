# SPDX-License-Identifier: Apache-2.0
"""A video driver after a script: it carries out each request on the kernel's structures.

It keeps the rules that a real one has (no streaming without buffers, no dequeueing of what was
not queued, no format change while buffers are out) and its own clock, which only waiting moves.
"""

import ctypes
import errno
import mmap
import os
import select
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from edge.cameras import v4l2_abi as abi

PERIOD_NS = 33_333_333
START_NS = 5_000_000_000_000
MONOTONIC_SOE = abi.BUF_FLAG_TIMESTAMP_MONOTONIC | abi.BUF_FLAG_TSTAMP_SRC_SOE


@dataclass(frozen=True)
class Picture:
    """An image that comes one period after the one before."""

    data: bytes
    skipped: int = 0  # images before it that the driver lost
    flags: int = MONOTONIC_SOE
    stamp_offset_ns: int = 0  # of its stamp from the time at which it comes
    late_s: float = 0.0  # longer to wait than a period


@dataclass(frozen=True)
class Failure:
    """A dequeueing that fails, once."""

    number: int


@dataclass(frozen=True)
class Unplugged:
    """From here on nothing works."""


@dataclass
class Control:
    """A setting with its limits."""

    minimum: int
    maximum: int
    value: int
    step: int = 1
    flags: int = 0
    allowed: tuple[int, ...] = ()  # of a menu
    keeps: Callable[[int], int] = lambda value: value


@dataclass
class ScriptedKernel:
    """One device; open it again and it goes on with its script."""

    script: list[Picture | Failure | Unplugged]
    sizes: dict[str, tuple[int, int]] = field(default_factory=lambda: {"GREY": (64, 48)})
    controls: dict[int, Control] = field(default_factory=dict)
    row_padding: int = 0
    capabilities: int = abi.CAP_VIDEO_CAPTURE | abi.CAP_STREAMING
    failing: dict[int, int] = field(default_factory=dict)  # request: error number
    open_error: int = 0
    fixed_rate: tuple[int, int] | None = None  # numerator, denominator of its period

    def __post_init__(self) -> None:
        self.now_ns = START_NS
        self.fds: set[int] = set()
        self.log: list[tuple[int, int]] = []  # controls as they were set
        self._plugged = True
        self._sequence = 0
        self._reset()

    def _reset(self) -> None:
        self._memory: list[mmap.mmap] = []
        self._queued: deque[int] = deque()
        self._streams = False
        self._format: tuple[str, int, int] | None = None

    # The seam.

    def open(self, path: str) -> int:
        if self.open_error:
            raise OSError(self.open_error, os.strerror(self.open_error))
        self._check_plugged()
        assert not self.fds, "opened twice"
        self._reset()
        self.fds.add(7)
        return 7

    def close(self, fd: int) -> None:
        self.fds.remove(fd)

    def mmap(self, fd: int, length: int, offset: int) -> mmap.mmap:
        assert fd in self.fds
        assert length == self._size()
        return self._memory[offset // 4096]

    def poll(self, fd: int, timeout_s: float) -> int:
        assert fd in self.fds
        if not self._plugged or not self._streams or not self.script:
            self.now_ns += round(timeout_s * 1e9)
            return 0 if self._plugged and self._streams else select.POLLERR
        event = self.script[0]
        if isinstance(event, Picture):
            return self._wait_for(event, timeout_s)
        if isinstance(event, Unplugged):
            self.script.pop(0)
            self._plugged = False
            return select.POLLERR | select.POLLHUP
        return select.POLLIN

    def _wait_for(self, picture: Picture, timeout_s: float) -> int:
        needed_ns = PERIOD_NS + round(picture.late_s * 1e9)
        if needed_ns > timeout_s * 1e9:
            self.now_ns += round(timeout_s * 1e9)
            waited = Picture(**{**vars(picture), "late_s": picture.late_s - timeout_s})
            self.script[0] = waited
            return 0
        return select.POLLIN if self._queued else 0

    def monotonic_ns(self) -> int:
        return self.now_ns

    def ioctl(self, fd: int, request: int, argument: Any) -> None:
        assert fd in self.fds
        self._check_plugged()
        if request in self.failing:
            raise OSError(self.failing[request], os.strerror(self.failing[request]))
        _HANDLERS[request](self, argument)

    # What a person does to it.

    def plug(self) -> None:
        """It is back, as a new device that counts from 0."""
        self._plugged = True
        self._sequence = 0

    # The requests.

    def _querycap(self, answer: abi.Capability) -> None:
        answer.card[:8] = b"Scripted"
        answer.capabilities = abi.CAP_DEVICE_CAPS | abi.CAP_VIDEO_CAPTURE | abi.CAP_STREAMING
        answer.device_caps = self.capabilities

    def _enum_fmt(self, entry: abi.FmtDesc) -> None:
        _demand(entry.type == abi.BUF_TYPE_VIDEO_CAPTURE and entry.index < len(self.sizes))
        entry.pixelformat = abi.fourcc(list(self.sizes)[entry.index])

    def _s_fmt(self, wanted: abi.Format) -> None:
        if self._memory:
            raise OSError(errno.EBUSY, "buffers are out")
        pix = wanted.fmt.pix
        name = abi.fourcc_name(pix.pixelformat)
        name = name if name in self.sizes else next(iter(self.sizes))
        width, height = self.sizes[name]
        pix.pixelformat, pix.width, pix.height = abi.fourcc(name), width, height
        pix.bytesperline = 0 if name == "MJPG" else width * _bytes(name) + self.row_padding
        self._format = (name, width, height)
        pix.sizeimage = self._size()

    def _size(self) -> int:
        assert self._format
        name, width, height = self._format
        rows = height * 3 // 2 if name == "NV12" else height
        return (width * _bytes(name) + self.row_padding) * rows

    def _s_parm(self, parm: abi.StreamParm) -> None:
        capture = parm.parm.capture
        capture.capability = abi.CAP_TIMEPERFRAME
        if self.fixed_rate:
            capture.timeperframe = abi.Fract(*self.fixed_rate)

    def _reqbufs(self, wanted: abi.RequestBuffers) -> None:
        _demand(wanted.memory == abi.MEMORY_MMAP and self._format is not None)
        self._memory = [mmap.mmap(-1, self._size()) for _ in range(wanted.count)]

    def _querybuf(self, buffer: abi.Buffer) -> None:
        _demand(buffer.index < len(self._memory))
        buffer.length, buffer.m.offset = self._size(), 4096 * buffer.index

    def _qbuf(self, buffer: abi.Buffer) -> None:
        _demand(buffer.index < len(self._memory) and buffer.index not in self._queued)
        # Who still reads a buffer that he gave back sees this.
        self._memory[buffer.index][:] = b"\xee" * self._size()
        self._queued.append(buffer.index)

    def _streamon(self, kind: ctypes.c_int) -> None:
        _demand(kind.value == abi.BUF_TYPE_VIDEO_CAPTURE and bool(self._queued))
        self._streams = True

    def _streamoff(self, kind: ctypes.c_int) -> None:
        self._streams = False
        self._queued.clear()

    def _dqbuf(self, buffer: abi.Buffer) -> None:
        _demand(buffer.type == abi.BUF_TYPE_VIDEO_CAPTURE and self._streams)
        if not self.script:
            raise BlockingIOError(errno.EAGAIN, "nothing yet")
        event = self.script.pop(0)
        if isinstance(event, Failure):
            if event.number in (errno.EIO, errno.ENODEV):
                self._sequence += event.number == errno.EIO
            raise OSError(event.number, os.strerror(event.number))
        assert isinstance(event, Picture)
        self._fill(buffer, event)

    def _fill(self, buffer: abi.Buffer, picture: Picture) -> None:
        self.now_ns += PERIOD_NS * (1 + picture.skipped) + round(picture.late_s * 1e9)
        self._sequence += picture.skipped
        buffer.index = self._queued.popleft()
        self._memory[buffer.index][: len(picture.data)] = picture.data
        buffer.bytesused, buffer.flags = len(picture.data), picture.flags
        buffer.sequence = self._sequence & 0xFFFFFFFF
        stamp_us = (self.now_ns + picture.stamp_offset_ns) // 1000
        buffer.timestamp = abi.TimeVal(*divmod(stamp_us, 1_000_000))
        self._sequence += 1

    def start_counting_at(self, sequence: int) -> None:
        """As if it had run for long."""
        self._sequence = sequence

    def _queryctrl(self, query: abi.QueryCtrl) -> None:
        _demand(query.id in self.controls)
        control = self.controls[query.id]
        query.minimum, query.maximum = control.minimum, control.maximum
        query.step, query.flags = control.step, control.flags

    def _s_ext_ctrls(self, request: abi.ExtControls) -> None:
        control, item = self._control(request)
        value = item.u.value
        if not control.minimum <= value <= control.maximum:
            raise OSError(errno.ERANGE, "out of range")
        _demand(not control.allowed or value in control.allowed)
        control.value = control.keeps(value)
        self.log.append((item.id, value))

    def _g_ext_ctrls(self, request: abi.ExtControls) -> None:
        control, item = self._control(request)
        item.u.value = control.value

    def _control(self, request: abi.ExtControls) -> tuple[Control, abi.ExtControl]:
        item = request.controls[0]
        _demand(request.count == 1 and request.which == item.id & 0x0FFF0000)
        _demand(item.id in self.controls)
        return self.controls[item.id], item

    def _check_plugged(self) -> None:
        if not self._plugged:
            raise OSError(errno.ENODEV, "No such device")


def _demand(fits: bool) -> None:
    if not fits:
        raise OSError(errno.EINVAL, "Invalid argument")


def _bytes(name: str) -> int:
    return 2 if name == "YUYV" else 1


_HANDLERS: dict[int, Callable[[ScriptedKernel, Any], None]] = {
    abi.QUERYCAP: ScriptedKernel._querycap,
    abi.ENUM_FMT: ScriptedKernel._enum_fmt,
    abi.S_FMT: ScriptedKernel._s_fmt,
    abi.S_PARM: ScriptedKernel._s_parm,
    abi.REQBUFS: ScriptedKernel._reqbufs,
    abi.QUERYBUF: ScriptedKernel._querybuf,
    abi.QBUF: ScriptedKernel._qbuf,
    abi.DQBUF: ScriptedKernel._dqbuf,
    abi.STREAMON: ScriptedKernel._streamon,
    abi.STREAMOFF: ScriptedKernel._streamoff,
    abi.QUERYCTRL: ScriptedKernel._queryctrl,
    abi.S_EXT_CTRLS: ScriptedKernel._s_ext_ctrls,
    abi.G_EXT_CTRLS: ScriptedKernel._g_ext_ctrls,
}


def grey(seed: int, width: int = 64, height: int = 48) -> np.ndarray:
    """An image of its own for each seed."""
    return np.random.default_rng(seed).integers(0, 256, (height, width), dtype=np.uint8)


def pictures(count: int, **more: Any) -> list[Picture]:
    """Grey images 0, 1, ..."""
    return [Picture(grey(index).tobytes(), **more) for index in range(count)]
