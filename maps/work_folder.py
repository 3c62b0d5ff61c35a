# SPDX-License-Identifier: Apache-2.0
"""Results of a build that is not finished yet, kept beside its output so that it can go on.

A hidden folder `.NAME.work` holds one file for each result, named by the hash of all that went
into it: the program, the settings, and the path, size and time of each file that was read. What a
kill leaves half-written, or a power cut spoils, does not pass its checksum and is made again. The
folder is gone when the map stands, and when its input is refused; it stays after an interruption,
and where something could not be written: with room, the same command goes on from there.
"""

import hashlib
import os
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import is_dataclass
from functools import cache
from pathlib import Path
from typing import Any, TypeVar, get_type_hints

import numpy as np

from edge.cameras.layout import ImageFile
from edge.errors import EdgeError, OutputError, TileError
from edge.runtime.kernel_cache import ROOT
from edge.tiles import format as tile_format
from edge.tiles.format import Array
from maps.workers import Workers

A = TypeVar("A")
B = TypeVar("B")

_DIGEST = hashlib.sha256().digest_size


class WorkFolder:
    """A store of results; one that cannot be written keeps nothing, and the build goes on."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._bytes = 0
        with suppress(OSError):
            self._bytes = sum(path.stat().st_size for path in folder.iterdir())

    def load(self, key: str, kind: type[B]) -> B | None:
        """The result of this key, a tuple or dataclass of arrays, if it is there and whole."""
        try:
            data = (self._folder / key).read_bytes()
        except OSError:
            return None
        if hashlib.sha256(data[_DIGEST:]).digest() != data[:_DIGEST]:
            return None
        try:
            arrays, _ = tile_format.decode(memoryview(data)[_DIGEST:], key)
        except TileError:
            return None
        return joined(kind, arrays)

    def keep(self, key: str, result: object) -> None:
        """Store a result under its key, whole or not at all.

        As much room as all results take is left to the map, which is smaller than they are.
        """
        data = tile_format.encode(taken_apart(result))
        temporary = self._folder / f"{key}.{os.getpid()}"
        with suppress(OSError):  # no room: the result is made again if the build is
            self._folder.mkdir(parents=True, exist_ok=True)
            if shutil.disk_usage(self._folder).free < self._bytes + 2 * len(data):
                return
            temporary.write_bytes(hashlib.sha256(data).digest() + data)
            temporary.replace(self._folder / key)
            self._bytes += len(data)

    def map(
        self, workers: Workers, function: Callable[[A], B], items: Sequence[A], keys: Sequence[str],
        kind: type[B],
    ) -> Iterator[B]:  # fmt: skip
        """Results of all items, in their order; only those that are not kept are made."""
        missing = [i for i, key in enumerate(keys) if not (self._folder / key).is_file()]
        made = iter(workers.map(function, [items[i] for i in missing]))
        absent = set(missing)
        for i, (item, key) in enumerate(zip(items, keys, strict=True)):
            if i in absent:
                result = next(made)
                self.keep(key, result)
            else:
                result = self.load(key, kind) or function(item)
            yield result


@contextmanager
def work_folder(target: Path) -> Iterator[WorkFolder]:
    """Give the work folder of a build of `target`."""
    folder = target.parent / f".{target.name}.work"
    try:
        yield WorkFolder(folder)
    except OutputError:
        raise
    except EdgeError:
        shutil.rmtree(folder, ignore_errors=True)
        raise
    shutil.rmtree(folder, ignore_errors=True)


def key_of(*parts: object) -> str:
    """Name of a result: the hash of all that it depends on, besides the program itself."""
    digest = hashlib.sha256(program_hash())
    for part in parts:
        data = part.tobytes() if isinstance(part, np.ndarray) else repr(part).encode()
        digest.update(len(data).to_bytes(8, "little") + data)
    return digest.hexdigest()


def stamp(file: ImageFile) -> tuple[object, ...]:
    """What tells whether a file is still the same: path, size and time of change."""
    try:
        if isinstance(file, Path):
            status = file.stat()
            return str(file.absolute()), status.st_size, status.st_mtime_ns
        return str(file), hashlib.sha256(file.read_bytes()).hexdigest()
    except (OSError, EdgeError):
        return (str(file),)


@cache
def program_hash() -> bytes:
    """Hash of the sources: another program may find something else."""
    digest = hashlib.sha256()
    for package in ("edge", "maps"):
        for path in sorted((ROOT / package).rglob("*.py")):
            digest.update(str(path.relative_to(ROOT)).encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.digest()


def taken_apart(value: object, name: str = "v") -> dict[str, Array]:
    """Arrays of a tuple or dataclass of arrays, and of such in it, by their names in it."""
    if isinstance(value, np.ndarray):
        return {name: np.ascontiguousarray(value)}
    arrays: dict[str, Array] = {}
    for field in _fields(type(value)):
        arrays.update(taken_apart(getattr(value, field), f"{name}.{field}"))
    return arrays


def joined(kind: type[B], arrays: dict[str, Array], name: str = "v") -> B:
    """The inverse of `taken_apart`."""
    fields = _fields(kind)
    if not fields:
        # A copy: kernels would be compiled anew for what cannot be written to.
        return arrays[name].copy()  # type: ignore[return-value]  # an array type
    hints = get_type_hints(kind)
    parts: dict[str, Any] = {}
    for field in fields:
        parts[field] = joined(hints[field], arrays, f"{name}.{field}")
    return kind(**parts)


def _fields(kind: Any) -> tuple[str, ...]:
    if is_dataclass(kind):
        return tuple(kind.__dataclass_fields__)
    return getattr(kind, "_fields", ())
