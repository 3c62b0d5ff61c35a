# SPDX-License-Identifier: Apache-2.0
"""Writes a map folder so that it appears whole or not at all."""

import fcntl
import glob
import hashlib
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from edge.errors import OutputError
from edge.store import durable
from edge.tiles import format as tile_format
from edge.tiles import manifest as manifest_format
from edge.tiles.manifest import Bounds, Manifest, TileEntry
from maps.assemble import TileArrays


@contextmanager
def new_map_folder(target: Path) -> Iterator[Path]:
    """Give a folder beside `target` that takes its place if all goes well, and vanishes if not.

    A map that is there already is replaced; anything else is refused. Where `target` is a link, the
    map is put where it leads. While it is being made the
    folder has a name that begins with a dot, and the manifest is written last, so that nothing
    half-made opens. What a killed process left of that is removed by the next one.
    """
    check_target(target)
    target = _followed(target)
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        _drop_abandoned(target)
        name = tempfile.mkdtemp(prefix=f".{target.name}-", suffix=durable.PART, dir=target.parent)
    except OSError as error:
        raise OutputError(f"{target}: cannot be made ({error.strerror}); choose another") from None
    partial = Path(name)
    claim = _claim(partial)  # held until this process ends, however it does
    try:
        (partial / "tiles").mkdir()
        yield partial
        partial.chmod(0o755)
        durable.replace_folder(partial, target)
    except OSError as error:
        raise OutputError(f"{target}: cannot be written ({error.strerror}); make room") from None
    finally:
        shutil.rmtree(partial, ignore_errors=True)
        if claim is not None:
            os.close(claim)


def _drop_abandoned(target: Path) -> None:
    for partial in target.parent.glob(f".{glob.escape(target.name)}-????????{durable.PART}"):
        if partial.is_dir() and (claim := _claim(partial)) is not None:
            shutil.rmtree(partial, ignore_errors=True)
            os.close(claim)


def _claim(folder: Path) -> int | None:
    """Lock a folder; None where another process holds it, or none can be held."""
    try:
        descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    except OSError:
        return None
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(descriptor)
        return None
    return descriptor


def check_target(target: Path) -> None:
    """OutputError where a map must not be written: before hours of work, not after."""
    if target.is_dir():
        if target.samefile("."):
            raise OutputError(f"{target}: is the folder that you are in; name a new one with --out")
        if not is_map(target) and any(target.iterdir()):
            raise OutputError(f"{target}: holds something that is no map; choose another --out")
    elif target.exists():
        raise OutputError(f"{target}: is a file; choose another --out")
    parents = [folder for folder in _followed(target).parents if folder.exists()]
    parent = parents[0]
    around = next((folder for folder in parents if is_map(folder)), None)
    if around is not None:
        raise OutputError(f"{target}: would lie within the map {around}; choose another --out")
    if not os.access(parent, os.W_OK | os.X_OK):
        raise OutputError(f"{target}: {parent} cannot be written to; choose another --out")


def check_not_source(target: Path, *sources: Path) -> None:
    """OutputError where a map would take the place of what it is made of, or of its folder."""
    for source in sources:
        if _followed(source).is_relative_to(_followed(target)):
            raise OutputError(f"{target}: is or holds what is to be read; choose another --out")


def _followed(target: Path) -> Path:
    """Where a path leads, as an exchange of names would put a map in the place of a link."""
    return Path(os.path.realpath(target))


def is_map(folder: Path) -> bool:
    """Whether there is a map, sound or not."""
    return (folder / manifest_format.FILE_NAME).is_file()


def write_tile(folder: Path, number: int, tile: TileArrays, layer: str = "") -> TileEntry:
    """Write one tile, of a `layer` that has its own; return its manifest entry."""
    path = f"tiles/{layer}" + "_".join(_cell_name(value) for value in tile.cell) + ".tile"
    data = tile_format.encode(tile.layers)
    durable.write_new(folder / path, [data])
    low, high = tile.low.tolist(), tile.high.tolist()
    return TileEntry(
        id=number,
        path=path,
        bytes=len(data),
        sha256=hashlib.sha256(data).hexdigest(),
        cell=tile.cell,
        origin_m=tuple(tile.origin.tolist()),
        bounds_m=Bounds(min=tuple(low), max=tuple(high)),
        keyframes=tile.n_keyframes,
        points=tile.n_points,
        lines=len(tile.layers.get("lines/point", ())),
    )


def write_manifest(folder: Path, manifest: Manifest) -> None:
    """Write manifest.json, the last file of a map."""
    durable.write_new(folder / manifest_format.FILE_NAME, [manifest_format.encode(manifest)])


def _cell_name(value: int) -> str:
    return f"{'m' if value < 0 else 'p'}{abs(value)}"
