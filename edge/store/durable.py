# SPDX-License-Identifier: Apache-2.0
"""Writes that a power cut leaves whole or undone: the only way that files are put in place.

The order is always the same: the bytes to the disk, then the name, then the folder. A name
that is on the disk before its bytes gives an empty file; a folder that is not synced gives
the old name back after it was said to be gone.
"""

import ctypes
import errno
import os
import shutil
import tempfile
from collections.abc import Iterable
from pathlib import Path

PART = ".part"  # ends the names of files that are not in place yet
_AT_FDCWD = -100
_RENAME_EXCHANGE = 2
# Filesystems and kernels that cannot exchange two names at once.
_NO_EXCHANGE = (errno.EINVAL, errno.ENOSYS, errno.ENOTSUP, errno.EPERM)


def write_new(path: Path, chunks: Iterable[bytes | memoryview], mode: int = 0o644) -> None:
    """Write a file that is not there yet, bytes to the disk; its folder is synced by the caller.

    Where anything fails nothing is left behind.
    """
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, mode)
    try:
        with os.fdopen(descriptor, "wb") as file:
            for chunk in chunks:
                file.write(chunk)
            file.flush()
            os.fsync(file.fileno())
    except BaseException:
        path.unlink(missing_ok=True)
        raise


def write_whole(path: Path, data: bytes, mode: int = 0o644) -> None:
    """Put `data` at `path`, in the place of what is there: at any moment the old or the new."""
    descriptor, name = tempfile.mkstemp(prefix=f".{path.name}.", suffix=PART, dir=path.parent)
    temporary = Path(name)
    try:
        with os.fdopen(descriptor, "wb") as file:
            file.write(data)
            file.flush()
            os.fchmod(file.fileno(), mode)
            os.fsync(file.fileno())
        temporary.replace(path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    sync_folder(path.parent)


def point(link: Path, target: str) -> None:
    """Let the symbolic link `link` lead to `target` from one moment to the next."""
    temporary = link.with_name(f".{link.name}.{os.getpid()}{PART}")
    temporary.unlink(missing_ok=True)
    try:
        temporary.symlink_to(target)
        temporary.replace(link)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    sync_folder(link.parent)


def move(source: Path, target: Path) -> None:
    """Rename what is already on the disk; both folders are synced."""
    source.rename(target)
    sync_folder(target.parent)
    if source.parent != target.parent:
        sync_folder(source.parent)


def make_folder(path: Path, mode: int = 0o755) -> None:
    """Make a folder, and those above it, that stay there; nothing where it is one already."""
    if path.is_dir():
        return
    if path.parent != path:
        make_folder(path.parent, mode)
    path.mkdir(mode=mode, exist_ok=True)
    sync_folder(path.parent)


def remove(path: Path) -> None:
    """Remove a file or link for good; nothing where there is none."""
    path.unlink(missing_ok=True)
    sync_folder(path.parent)


def replace_folder(partial: Path, target: Path) -> None:
    """Put the folder `partial`, whose files are on the disk, in the place of `target`.

    A folder that is there gives way in the same moment where the system can do that, and goes
    only once the new one stands.
    """
    sync_tree(partial)
    if not target.is_dir():
        partial.rename(target)
    elif _exchange(partial, target):
        sync_folder(target.parent)
        shutil.rmtree(partial, ignore_errors=True)
    else:
        _replace_in_two_steps(partial, target)
    sync_folder(target.parent)


def sync_file(path: Path) -> None:
    """See the bytes of a file that is written already to the disk."""
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def sync_folder(folder: Path) -> None:
    """See the names in `folder` to the disk."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def sync_tree(folder: Path) -> None:
    """See the names in `folder` and all folders below it to the disk; not the files' bytes."""
    for below, _, _ in os.walk(folder, topdown=False):
        sync_folder(Path(below))


def _exchange(one: Path, other: Path) -> bool:
    """Exchange two names at once; False where the system cannot."""
    renameat2 = getattr(ctypes.CDLL(None, use_errno=True), "renameat2", None)
    if renameat2 is None:
        return False
    names = os.fsencode(one), os.fsencode(other)
    if renameat2(_AT_FDCWD, names[0], _AT_FDCWD, names[1], _RENAME_EXCHANGE) == 0:
        return True
    code = ctypes.get_errno()
    if code in _NO_EXCHANGE:
        return False
    raise OSError(code, os.strerror(code), str(other))


def _replace_in_two_steps(partial: Path, target: Path) -> None:
    old = Path(tempfile.mkdtemp(prefix=f".{target.name}-old-", dir=target.parent))
    target.rename(old)
    try:
        partial.rename(target)
    except OSError:
        old.rename(target)
        raise
    sync_folder(target.parent)
    shutil.rmtree(old, ignore_errors=True)
