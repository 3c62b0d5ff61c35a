# SPDX-License-Identifier: Apache-2.0
"""Opens files from people: regular ones alone, whatever lies there under the name."""

import errno
import os
import stat
from pathlib import Path
from typing import BinaryIO


def open_regular(path: Path, *, follow: bool = False) -> BinaryIO:
    """Open a file for reading; OSError (EINVAL) if it is a folder, pipe or device.

    A link is refused unless `follow`; a pipe does not hang us.
    """
    flags = os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC | (0 if follow else os.O_NOFOLLOW)
    descriptor = os.open(path, flags)
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise OSError(errno.EINVAL, "is no regular file", str(path))
    return os.fdopen(descriptor, "rb")


def read_start(path: Path, most_bytes: int, *, follow: bool = False) -> bytes:
    """First bytes of a regular file; none of anything else, or what cannot be read."""
    try:
        with open_regular(path, follow=follow) as file:
            return file.read(most_bytes)
    except OSError:
        return b""
