# SPDX-License-Identifier: Apache-2.0
"""A disk that remembers every write and flush in their order, served to the kernel as one file.

The kernel's loop device makes a block device of a file; that file is this FUSE server. What
arrives here is what would arrive at a real disk: ext4's block writes, and a sync for each flush
of the disk's cache. `python block_server.py IMAGE FILE LOG` serves IMAGE as FILE until its
standard input ends; a line there is noted in the LOG as a mark, and answered by a line.
"""

import contextlib
import ctypes
import errno
import os
import select
import struct
import sys
from pathlib import Path
from typing import BinaryIO, NamedTuple

WRITE, FLUSH, MARK = 1, 2, 3
_ENTRY = struct.Struct("<BQI")
_IN = struct.Struct("<IIQQIIIHH")
_OUT = struct.Struct("<IiQ")
_ATTR_TIMES = struct.Struct("<QII")
_ATTR = struct.Struct("<6Q10I")
_READ = struct.Struct("<QQIIQII")
_INIT_OUT = struct.Struct("<IIIIHHIIHHI28x")
_MAX_WRITE = 128 << 10
_BIG_WRITES = 1 << 5
_GETATTR, _OPEN, _READ_OP, _WRITE_OP, _STATFS = 3, 14, 15, 16, 17
_RELEASE, _FSYNC, _FLUSH_OP, _INIT, _INTERRUPT, _FORGET, _DESTROY = 18, 20, 25, 26, 36, 2, 38


class Entry(NamedTuple):
    """What reached the disk."""

    kind: int
    offset: int
    data: bytes  # of a write; the text of a mark


class Disk:
    """The image in memory, and the log of what was done to it."""

    def __init__(self, image: bytes, log: BinaryIO) -> None:
        self._image = bytearray(image)
        self._log = log

    def answer(self, opcode: int, body: bytes) -> bytes | int:
        """Reply to one request of the kernel, or the error code of one that is not known."""
        if opcode == _INIT:
            return _INIT_OUT.pack(7, 31, _MAX_WRITE, _BIG_WRITES, 16, 12, _MAX_WRITE, 1, 32, 0, 0)
        if opcode == _GETATTR:
            size = len(self._image)
            attr = _ATTR.pack(1, size, size // 512, *[0] * 6, 0o100600, 1, 0, 0, 0, 4096, 0)
            return _ATTR_TIMES.pack(3600, 0, 0) + attr
        if opcode == _OPEN:
            return struct.pack("<QII", 1, 0, 0)
        if opcode == _READ_OP:
            _, offset, size, *_ = _READ.unpack_from(body)
            return bytes(self._image[offset : offset + size])
        if opcode == _WRITE_OP:
            _, offset, size, *_ = _READ.unpack_from(body)
            data = body[_READ.size : _READ.size + size]
            self._image[offset : offset + size] = data
            self.note(Entry(WRITE, offset, data))
            return struct.pack("<II", size, 0)
        if opcode == _FSYNC:
            self.note(Entry(FLUSH, 0, b""))
            return b""
        return b"" if opcode in (_RELEASE, _FLUSH_OP, _DESTROY) else errno.ENOSYS

    def note(self, entry: Entry) -> None:
        """Append to the log."""
        self._log.write(_ENTRY.pack(entry.kind, entry.offset, len(entry.data)) + entry.data)


def read_log(path: Path) -> list[Entry]:
    """Everything that reached the disk, in its order."""
    data, entries, at = path.read_bytes(), [], 0
    while at < len(data):
        kind, offset, length = _ENTRY.unpack_from(data, at)
        at += _ENTRY.size
        entries.append(Entry(kind, offset, data[at : at + length]))
        at += length
    return entries


def serve(image: Path, file: Path, log: Path) -> None:
    """Serve until standard input ends."""
    libc = ctypes.CDLL(None, use_errno=True)
    fuse = os.open("/dev/fuse", os.O_RDWR | os.O_CLOEXEC)
    options = f"fd={fuse},rootmode=100600,user_id=0,group_id=0".encode()
    if libc.mount(b"power-cut", os.fsencode(file), b"fuse", 0, options) != 0:
        sys.exit(f"cannot mount: {os.strerror(ctypes.get_errno())}")
    with log.open("wb") as out:
        disk = Disk(image.read_bytes(), out)
        # A mount begins with INIT, so its answer must not wait for a mark.
        _say("ready")
        while True:
            ready, _, _ = select.select([fuse, sys.stdin.buffer], [], [])
            if fuse in ready and not _serve_one(fuse, disk):
                return
            if sys.stdin.buffer in ready:
                line = sys.stdin.buffer.raw.readline()  # type: ignore[attr-defined]
                if not line:
                    return
                disk.note(Entry(MARK, 0, line.strip()))
                out.flush()
                _say("noted")


def _say(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def _serve_one(fuse: int, disk: Disk) -> bool:
    """Answer one request; False once the file is unmounted."""
    try:
        request = os.read(fuse, _MAX_WRITE + 4096)
    except OSError as error:
        return error.errno != errno.ENODEV
    _, opcode, unique, *_ = _IN.unpack_from(request)
    if opcode in (_FORGET, _INTERRUPT):
        return True
    reply = disk.answer(opcode, request[_IN.size :])
    payload, code = (b"", -reply) if isinstance(reply, int) else (reply, 0)
    with contextlib.suppress(FileNotFoundError):  # who asked was interrupted
        os.write(fuse, _OUT.pack(_OUT.size + len(payload), code, unique) + payload)
    return True


if __name__ == "__main__":
    serve(*(Path(argument) for argument in sys.argv[1:4]))
