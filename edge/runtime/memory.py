# SPDX-License-Identifier: Apache-2.0
"""Keeps the process small: settings of glibc's allocator and of Python's collector."""

import ctypes
import gc
from collections.abc import Iterator
from pathlib import Path

# Parameters of mallopt, as glibc numbers them.
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD, _M_ARENA_MAX = -1, -3, -8
_MMAP_BYTES = 1 << 20  # an image; smaller ones are not worth the page faults
_TRIM_BYTES = 4 << 20
_COMPILER = "libllvmlite"  # loaded kernels do not need it: some 30 MB were touched at start-up
_MADV_DONTNEED = 4
_ARENAS = 2  # by default each thread has one of its own, with holes of its own


def keep_small() -> None:
    """Let freed memory go back to the system; with another C library nothing happens."""
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(_M_ARENA_MAX, _ARENAS)
        # Set by hand it stays: else it grows with what is freed, and images end up in the heap.
        mallopt(_M_MMAP_THRESHOLD, _MMAP_BYTES)
        mallopt(_M_TRIM_THRESHOLD, _TRIM_BYTES)


def settle_down() -> None:
    """Give back what start-up has used, and let the collector pass over what stays for good."""
    gc.collect()
    gc.freeze()
    libc = ctypes.CDLL(None)
    if hasattr(libc, "malloc_trim"):
        libc.malloc_trim(0)
    for begin, end in _code_of(_COMPILER):
        # Read anew from the file if it ever runs again; only code, as data may have been changed.
        libc.madvise(ctypes.c_void_p(begin), ctypes.c_size_t(end - begin), _MADV_DONTNEED)


def _code_of(library: str) -> Iterator[tuple[int, int]]:
    """Where the code of a loaded library lies: addresses of its pages that nobody can write to."""
    for line in Path("/proc/self/maps").read_text(errors="replace").splitlines():
        span, rights, *_, path = line.split(maxsplit=5)
        if rights == "r-xp" and library in path:
            begin, end = (int(text, 16) for text in span.split("-"))
            yield begin, end
