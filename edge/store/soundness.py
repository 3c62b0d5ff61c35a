# SPDX-License-Identifier: Apache-2.0
"""Whether what lies in the store is what its records say."""

import hashlib
import os
from pathlib import Path

from edge.errors import TileError
from edge.store.bundle import BundleFile
from edge.store.records import Generation, StoredFile
from edge.tiles.reader import open_map, read_manifest

_CHUNK = 1 << 20


def check_map(folder: Path, generation: Generation) -> None:
    """TileError unless the folder opens, and holds what the manifest says and nothing else."""
    files = {entry.path: (entry.bytes, entry.sha256) for entry in generation.files}
    manifest = read_manifest(folder)
    named = {file.path: (file.bytes, file.sha256) for file in manifest.files()}
    if named != {path: file for path, file in files.items() if path.startswith("tiles/")}:
        raise TileError("its manifest names other tiles than the bundle")
    open_map(folder)


def is_sound(path: Path, entry: BundleFile | StoredFile) -> bool:
    """Whether a file has the bytes that its hash says."""
    digest = hashlib.sha256()
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC)
    except OSError:
        return False
    with os.fdopen(descriptor, "rb") as file:
        if os.fstat(file.fileno()).st_size != entry.bytes:
            return False
        while chunk := file.read(_CHUNK):
            digest.update(chunk)
    return digest.hexdigest() == entry.sha256
