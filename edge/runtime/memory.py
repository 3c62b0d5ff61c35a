# SPDX-License-Identifier: Apache-2.0
"""Keeps the process small: settings of glibc's allocator and of Python's collector."""

import ctypes
import gc

# Parameters of mallopt, as glibc numbers them.
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD, _M_ARENA_MAX = -1, -3, -8
_MMAP_BYTES = 1 << 20  # an image; smaller ones are not worth the page faults
_TRIM_BYTES = 4 << 20
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
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)
