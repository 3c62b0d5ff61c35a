# SPDX-License-Identifier: Apache-2.0
"""One open video device: its format and rate, and the buffers that it fills."""

import ctypes
import errno
import logging
import mmap
import os
import select
from collections.abc import Callable
from typing import NamedTuple

from edge.cameras import v4l2_abi as abi
from edge.cameras.v4l2_kernel import Kernel
from edge.errors import CameraLost, CameraRefused

log = logging.getLogger(__name__)

_REMEDIES = {
    errno.ENOENT: "it is not plugged in",
    errno.ENODEV: "it was unplugged",
    errno.ENXIO: "it was unplugged",
    errno.EACCES: "add the user to the group video",
    errno.EBUSY: "end the other program that uses it",
    errno.ENOSPC: "the USB bus is full: give it a bus of its own, a lower rate or MJPG",
    errno.EIO: "check its cable",
    errno.ENOTTY: "it is no video device",
    errno.EPROTO: "check its cable",
}


class PixelFormat(NamedTuple):
    """What the buffers hold."""

    name: str  # GREY, YUYV, NV12 or MJPG
    width: int
    height: int
    row_bytes: int
    image_bytes: int  # of a whole image; of MJPG the most


class Filled(NamedTuple):
    """A buffer that the driver has filled."""

    buffer: int
    used_bytes: int
    flags: int
    sequence: int
    stamp_ns: int


def lost(path: str, error: OSError) -> CameraLost:
    """What a failing system call means, in a person's words."""
    reason = os.strerror(error.errno) if error.errno else str(error)
    remedy = _REMEDIES.get(error.errno or 0)
    return CameraLost(f"{path}: {reason}" + (f": {remedy}" if remedy else ""))


class VideoStream:
    """A device from opening to closing; each error of the system becomes CameraLost.

    Owned by one thread.
    """

    def __init__(self, kernel: Kernel, path: str) -> None:
        self._kernel = kernel
        self.path = path
        self._memory: list[mmap.mmap] = []
        self._streams = False
        self._fd = -1
        try:
            self._fd = kernel.open(path)
        except OSError as error:
            raise lost(path, error) from error
        try:
            self.card = self._check_capability()
        except BaseException:
            self.close()
            raise

    def request(self, number: int, argument: ctypes.Structure | ctypes.c_int) -> None:
        """An ioctl; CameraLost where it fails."""
        try:
            self._kernel.ioctl(self._fd, number, argument)
        except OSError as error:
            raise lost(self.path, error) from error

    def try_request(self, number: int, argument: ctypes.Structure) -> bool:
        """An ioctl that a driver may lack or refuse; whether it was done. CameraLost if gone."""
        try:
            self._kernel.ioctl(self._fd, number, argument)
        except OSError as error:
            refusals = (errno.EINVAL, errno.ENOTTY, errno.ERANGE, errno.EACCES, errno.EBUSY)
            if error.errno in refusals:
                return False
            raise lost(self.path, error) from error
        return True

    def choose_format(self, names: tuple[str, ...], width: int, height: int) -> PixelFormat:
        """Set the first of the formats that the device gives in just this size."""
        offered = self._offered()
        given: list[str] = []
        for name in names:
            if name not in offered:
                continue
            wanted = abi.Format(type=abi.BUF_TYPE_VIDEO_CAPTURE)
            pix = wanted.fmt.pix
            pix.width, pix.height, pix.field = width, height, abi.FIELD_NONE
            pix.pixelformat = abi.fourcc(name)
            self.request(abi.S_FMT, wanted)
            got = (abi.fourcc_name(pix.pixelformat), pix.width, pix.height)
            if got == (name, width, height):
                row_bytes, image_bytes = _plane(name, pix)
                return PixelFormat(name, width, height, row_bytes, image_bytes)
            given.append("{} {}x{}".format(*got))
        has = ", ".join(given) or ", ".join(offered) or "nothing"
        raise CameraRefused(
            f"{self.path}: gives {has}, not {' or '.join(names)} in {width}x{height}: "
            "set a size that it has, and calibrate for that"
        )

    def set_rate(self, rate_hz: float) -> float:
        """Ask for a frame rate [Hz]; returns what the device will give."""
        parm = abi.StreamParm(type=abi.BUF_TYPE_VIDEO_CAPTURE)
        period = parm.parm.capture.timeperframe
        period.numerator, period.denominator = 1000, round(1000 * rate_hz)
        if not self.try_request(abi.S_PARM, parm):
            log.warning("event=camera_rate_unset device=%s: it sets its rate itself", self.path)
            return rate_hz
        settable = parm.parm.capture.capability & abi.CAP_TIMEPERFRAME
        if not settable or period.numerator == 0 or period.denominator == 0:
            return rate_hz
        return float(period.denominator / period.numerator)

    def start(self, buffers: int) -> None:
        """Share memory with the driver and let it fill it."""
        wanted = abi.RequestBuffers(
            count=buffers, type=abi.BUF_TYPE_VIDEO_CAPTURE, memory=abi.MEMORY_MMAP
        )
        self.request(abi.REQBUFS, wanted)
        if wanted.count < 2:
            raise CameraLost(f"{self.path}: has memory for {wanted.count} images only")
        for index in range(wanted.count):
            buffer = _buffer(index)
            self.request(abi.QUERYBUF, buffer)
            try:
                memory = self._kernel.mmap(self._fd, buffer.length, buffer.m.offset)
            except OSError as error:
                raise lost(self.path, error) from error
            self._memory.append(memory)
            self.request(abi.QBUF, buffer)
        self.request(abi.STREAMON, ctypes.c_int(abi.BUF_TYPE_VIDEO_CAPTURE))
        self._streams = True

    def next_filled(self, timeout_s: float) -> Filled | None:
        """A filled buffer, which `give_back` must follow; None when there is none in time.

        OSError EIO is a loss of one image, which the caller may bear.
        """
        try:
            events = self._kernel.poll(self._fd, timeout_s)
        except OSError as error:
            raise lost(self.path, error) from error
        if not events & select.POLLIN:
            if events:
                raise CameraLost(f"{self.path}: was unplugged or has stopped")
            return None
        buffer = _buffer(0)
        try:
            self._kernel.ioctl(self._fd, abi.DQBUF, buffer)
        except BlockingIOError:
            return None
        except OSError as error:
            if error.errno == errno.EIO:
                raise
            raise lost(self.path, error) from error
        stamp = buffer.timestamp
        stamp_ns = stamp.tv_sec * 1_000_000_000 + stamp.tv_usec * 1_000
        return Filled(buffer.index, buffer.bytesused, buffer.flags, buffer.sequence, stamp_ns)

    def memory(self, index: int) -> mmap.mmap:
        """What the driver has filled; it changes once it is given back."""
        return self._memory[index]

    def give_back(self, index: int) -> None:
        """Let the driver fill the buffer again."""
        self.request(abi.QBUF, _buffer(index))

    def close(self) -> None:
        """End it; a device that is gone already is no error."""
        if self._fd < 0:
            return
        kind = ctypes.c_int(abi.BUF_TYPE_VIDEO_CAPTURE)
        if self._streams:
            self._quietly(lambda: self._kernel.ioctl(self._fd, abi.STREAMOFF, kind))
            self._streams = False
        for memory in self._memory:
            self._quietly(memory.close)
        self._memory.clear()
        self._quietly(lambda: self._kernel.close(self._fd))
        self._fd = -1

    def _quietly(self, action: Callable[[], None]) -> None:
        try:
            action()
        except OSError as error:
            log.debug("event=camera_close device=%s: %s", self.path, error)

    def _check_capability(self) -> str:
        """Name of the device; CameraRefused unless it gives video to read."""
        answer = abi.Capability()
        self.request(abi.QUERYCAP, answer)
        per_node = answer.capabilities & abi.CAP_DEVICE_CAPS
        has = answer.device_caps if per_node else answer.capabilities
        if not has & abi.CAP_VIDEO_CAPTURE or not has & abi.CAP_STREAMING:
            raise CameraRefused(
                f"{self.path}: gives no video (a camera's other nodes give metadata only): "
                "name its video-index0"
            )
        return bytes(answer.card).split(b"\0")[0].decode("utf-8", "replace")

    def _offered(self) -> list[str]:
        names: list[str] = []
        for index in range(64):
            entry = abi.FmtDesc(index=index, type=abi.BUF_TYPE_VIDEO_CAPTURE)
            if not self.try_request(abi.ENUM_FMT, entry):
                break
            names.append(abi.fourcc_name(entry.pixelformat))
        return names


def _buffer(index: int) -> abi.Buffer:
    return abi.Buffer(index=index, type=abi.BUF_TYPE_VIDEO_CAPTURE, memory=abi.MEMORY_MMAP)


def _plane(name: str, pix: abi.PixFormat) -> tuple[int, int]:
    """Bytes of a row and of an image; some drivers leave the first at zero."""
    if name == "MJPG":
        return 0, pix.sizeimage
    least = pix.width * (2 if name == "YUYV" else 1)
    row_bytes = max(pix.bytesperline, least)
    rows = pix.height + (pix.height // 2 if name == "NV12" else 0)  # its colours lie below
    return row_bytes, row_bytes * (rows - 1) + least
