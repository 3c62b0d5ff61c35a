# SPDX-License-Identifier: Apache-2.0
"""The system calls that a video device needs: the one place where Linux is touched."""

import ctypes
import fcntl
import mmap
import os
import select
import time
from typing import Protocol


class Kernel(Protocol):
    """What a camera asks of the system. Failures are OSError with the kernel's number."""

    def open(self, path: str) -> int:
        """A descriptor that does not block."""
        ...

    def close(self, fd: int) -> None:
        """Give the descriptor back."""
        ...

    def ioctl(self, fd: int, request: int, argument: ctypes.Structure | ctypes.c_int) -> None:
        """Carry out a request; the kernel writes its answer into `argument`."""
        ...

    def mmap(self, fd: int, length: int, offset: int) -> mmap.mmap:
        """Memory that the driver fills."""
        ...

    def poll(self, fd: int, timeout_s: float) -> int:
        """Events (POLLIN, POLLERR, ...) that have come within the time, or 0."""
        ...

    def monotonic_ns(self) -> int:
        """CLOCK_MONOTONIC, by which drivers stamp."""
        ...


class LinuxKernel:
    """The real one."""

    def open(self, path: str) -> int:
        """Open for reading and writing, as settings need both."""
        return os.open(path, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)

    def close(self, fd: int) -> None:
        """Give the descriptor back."""
        os.close(fd)

    def ioctl(self, fd: int, request: int, argument: ctypes.Structure | ctypes.c_int) -> None:
        """Carry it out; what a signal interrupts is begun again."""
        while True:
            try:
                fcntl.ioctl(fd, request, argument, True)
            except InterruptedError:
                continue
            return

    def mmap(self, fd: int, length: int, offset: int) -> mmap.mmap:
        """Shared memory of the driver."""
        return mmap.mmap(
            fd, length, flags=mmap.MAP_SHARED, prot=mmap.PROT_READ | mmap.PROT_WRITE, offset=offset
        )

    def poll(self, fd: int, timeout_s: float) -> int:
        """Wait for a filled buffer or an error."""
        poller = select.poll()
        poller.register(fd, select.POLLIN)
        events = poller.poll(round(timeout_s * 1e3))
        return events[0][1] if events else 0

    def monotonic_ns(self) -> int:
        """CLOCK_MONOTONIC."""
        return time.monotonic_ns()
