# SPDX-License-Identifier: Apache-2.0
"""Makes the signed file that carries a map to devices; edge/store/BUNDLE.md has every byte."""

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

import msgspec

from edge import __version__
from edge.config.relocalise import RelocaliseConfig
from edge.config.tiles import TilesConfig
from edge.errors import OutputError, TileError
from edge.geometry.camera import load_camera
from edge.runtime.swap_selftest import HeldOutResult, choose_held_out, find_held_out
from edge.store import durable
from edge.store.bundle import FORMAT, SEAL, BundleFile, BundleHeader, HeldOut, encode_head
from edge.store.trust import key_id
from edge.tiles.manifest import FILE_NAME, camera_entry
from edge.tiles.reader import Map, open_map
from maps.signing import SIGNATURE_NAME, load_private_key
from maps.verification import verify

_CHUNK = 1 << 20
_LEAST_FOUND = 0.5  # of the held-out keyframes: less is no map to send anybody


@dataclass(frozen=True, slots=True, kw_only=True)
class BundleOrder:
    """For whom a bundle is, and from when to when."""

    site: str
    map_version: int | None = None  # None: the time in UTC, as a number that rises
    runtime_min: str = __version__
    expires: datetime | None = None
    cameras: Sequence[Path] = ()  # calibrations of the devices that it is for; none: any
    base: Path | None = None  # map that the devices have already
    untested: bool = False  # send it without trying whether it can be localised in


class BundleReport(NamedTuple):
    """What was made."""

    header: BundleHeader
    bytes: int
    held_out: HeldOutResult


def bundle(map_folder: Path, key: Path, out: Path, order: BundleOrder) -> BundleReport:
    """Write the bundle `out` of a map that is in order."""
    private = load_private_key(key)
    verify(map_folder)
    opened = open_map(map_folder)
    held_out, result = _held_out(opened, order.untested)
    files = _files(map_folder, opened, order.base)
    header = _header(opened, files, held_out, order)
    data = msgspec.json.encode(header)
    carried = [entry for entry in files if entry.carried]
    size = sum(entry.bytes for entry in carried)
    public = private.public_key()
    head, signer = encode_head(data, size), bytes.fromhex(key_id(public))
    seal = SEAL.pack(signer, private.sign(head + signer + data))
    try:
        _write(out, head + seal + data, [map_folder / entry.path for entry in carried])
    except OSError as error:
        raise OutputError(f"{out}: cannot be written ({error.strerror}); make room") from None
    return BundleReport(header, len(head) + len(seal) + len(data) + size, result)


def version_now() -> int:
    """Version of a bundle made now: YYYYMMDDhhmmss in UTC."""
    return int(datetime.now(UTC).strftime("%Y%m%d%H%M%S"))


def _held_out(opened: Map, untested: bool) -> tuple[HeldOut, HeldOutResult]:
    """What devices have to find, and what was found here."""
    if untested:
        return HeldOut(keyframes=[], found=0), HeldOutResult(0, 0, 0)
    keyframes = choose_held_out(opened.n_keyframes)
    result = find_held_out(opened, keyframes, RelocaliseConfig(), TilesConfig())
    if not result.tried or result.found < _LEAST_FOUND * result.tried or result.wrong > 1:
        raise TileError(
            f"{opened.folder}: only {result.found} of {result.tried} held-out keyframes are found "
            f"in it, {result.wrong} at a wrong place; take more images, or --untested"
        )
    return HeldOut(keyframes=keyframes, found=result.found), result


def _files(folder: Path, opened: Map, base: Path | None) -> list[BundleFile]:
    known = set() if base is None else {file.sha256 for file in open_map(base).manifest.files()}
    files = [_small_file(folder, FILE_NAME)]
    if (folder / SIGNATURE_NAME).is_file():
        files.append(_small_file(folder, SIGNATURE_NAME))
    for file in opened.manifest.files():
        carried = file.sha256 not in known
        files.append(
            BundleFile(path=file.path, bytes=file.bytes, sha256=file.sha256, carried=carried)
        )
    return files


def _small_file(folder: Path, name: str) -> BundleFile:
    data = (folder / name).read_bytes()
    digest = hashlib.sha256(data).hexdigest()
    return BundleFile(path=name, bytes=len(data), sha256=digest, carried=True)


def _header(
    opened: Map, files: list[BundleFile], held_out: HeldOut, order: BundleOrder
) -> BundleHeader:
    manifest = opened.manifest
    calibrations = sorted({camera_entry(load_camera(file)).id for file in order.cameras})
    header = BundleHeader(
        format=FORMAT,
        site=order.site,
        map_version=version_now() if order.map_version is None else order.map_version,
        runtime_min=order.runtime_min,
        vocabulary=manifest.vocabulary.id,
        extractor=str(manifest.extractor),
        opencv=manifest.opencv,
        cameras=[camera.id for camera in manifest.cameras],
        expires_utc=None if order.expires is None else order.expires.astimezone(UTC).isoformat(),
        calibrations=calibrations or None,
        base=None if order.base is None else _small_file(order.base, FILE_NAME).sha256,
        held_out=held_out,
        files=files,
    )
    try:  # the types check what was given on the command line
        return msgspec.json.decode(msgspec.json.encode(header), type=BundleHeader)
    except msgspec.ValidationError as error:
        raise OutputError(f"{opened.folder}: cannot be bundled so: {error}") from None


def _write(out: Path, head: bytes, files: list[Path]) -> None:
    def chunks() -> Iterator[bytes]:
        yield head
        for path in files:
            with path.open("rb") as file:
                while chunk := file.read(_CHUNK):
                    yield chunk

    part = out.with_name(f".{out.name}{durable.PART}")
    part.unlink(missing_ok=True)
    durable.write_new(part, chunks())
    try:
        durable.move(part, out)
    except OSError:
        part.unlink()
        raise
