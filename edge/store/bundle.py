# SPDX-License-Identifier: Apache-2.0
"""A bundle: one signed file that carries a map, or what is new of it. BUNDLE.md has every byte.

Nothing of a bundle is believed, not even read as JSON, before its signature is found right;
what it carries is hashed while it is copied.
"""

import hashlib
import os
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from types import TracebackType
from typing import Annotated, BinaryIO, Self

import msgspec

from edge.errors import BundleRefused
from edge.store.regular import open_regular
from edge.store.trust import TrustedKeys

SUFFIX = ".mapbundle"
MAGIC = b"mapvoBDL"
CONTAINER_VERSION = 1
HEAD = struct.Struct("<8sIIQ")  # magic, container version, length of the header, of the file
SEAL = struct.Struct("<32s64s")  # key id, Ed25519 signature over head, key id and header
MAX_HEADER_BYTES = 16 << 20
MAX_FILES = (1 << 16) + 2
_CHUNK = 1 << 20

Sha256 = Annotated[str, msgspec.Meta(pattern=r"^[0-9a-f]{64}\Z")]
Name = Annotated[str, msgspec.Meta(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,63}\Z")]
_Path = Annotated[
    str, msgspec.Meta(pattern=r"^(manifest\.json|manifest\.sig|tiles/[a-z0-9_]{1,64}\.tile)\Z")
]
_Version = Annotated[str, msgspec.Meta(pattern=r"^[0-9]{1,6}(\.[0-9]{1,6}){0,3}\Z")]


class BundleFile(msgspec.Struct, frozen=True, kw_only=True):
    """One file of the map."""

    path: _Path
    bytes: Annotated[int, msgspec.Meta(ge=1, le=1 << 40)]
    sha256: Sha256
    carried: bool  # in this bundle; else the device has it from an earlier one


class HeldOut(msgspec.Struct, frozen=True, kw_only=True):
    """Keyframes to be found again in the map without their own help, and how many were."""

    keyframes: Annotated[list[Annotated[int, msgspec.Meta(ge=0)]], msgspec.Meta(max_length=256)]
    found: Annotated[int, msgspec.Meta(ge=0)]


class BundleHeader(msgspec.Struct, frozen=True, kw_only=True):
    """What a bundle is and for whom. Fields that this program does not know are passed over."""

    format: str
    site: Name
    map_version: Annotated[int, msgspec.Meta(ge=1, lt=1 << 62)]  # of a site; rises
    runtime_min: _Version
    vocabulary: Sha256
    extractor: str  # for people; the map's manifest has the settings
    opencv: str
    cameras: list[Sha256]  # calibrations that made the map
    expires_utc: str | None  # ISO 8601
    calibrations: list[Sha256] | None  # of the devices that it is for; None: any
    base: Sha256 | None  # manifest.json of the map that a difference is against
    held_out: HeldOut
    files: Annotated[list[BundleFile], msgspec.Meta(min_length=2, max_length=MAX_FILES)]


FORMAT = "mapvo bundle"


@dataclass(frozen=True, slots=True, kw_only=True)
class Device:
    """What a bundle has to fit."""

    runtime: str  # version of this program
    vocabulary: str | None = None
    site: str = ""  # empty: any
    calibration: str | None = None  # of the camera; None: not known
    now: datetime | None = None  # None: expiry is not checked


class OpenBundle:
    """A bundle whose signature and header are right; its files are read in their order."""

    def __init__(self, file: BinaryIO, name: Path, data: bytes, header: BundleHeader) -> None:
        self.header = header
        self.id = hashlib.sha256(data).hexdigest()  # of all that was signed about the map
        self.name = name
        self._file = file
        self._begin = HEAD.size + SEAL.size + len(data)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        value: BaseException | None,
        at: TracebackType | None,
    ) -> None:
        self._file.close()

    def read(self, wanted: BundleFile) -> Iterator[bytes]:
        """Bytes of a carried file, in pieces; BundleRefused at their end if the hash is wrong."""
        carried = [entry for entry in self.header.files if entry.carried]
        before = carried[: carried.index(wanted)]
        self._file.seek(self._begin + sum(entry.bytes for entry in before))
        digest, left = hashlib.sha256(), wanted.bytes
        while left:
            chunk = self._read(min(left, _CHUNK))
            if not chunk:
                raise BundleRefused(f"{self.name}: ends in {wanted.path}; copy it again")
            digest.update(chunk)
            left -= len(chunk)
            yield chunk
        if digest.hexdigest() != wanted.sha256:
            raise BundleRefused(
                f"{self.name}: {wanted.path} is not what was signed; copy the bundle again"
            )

    def _read(self, most_bytes: int) -> bytes:
        try:
            return self._file.read(most_bytes)
        except OSError as error:  # the stick was pulled out, or is broken
            raise _unreadable(self.name, error) from None


def open_bundle(path: Path, keys: TrustedKeys) -> OpenBundle:
    """Open a bundle that a trusted key has signed; BundleRefused says what is wrong with it."""
    file, size = _open(path)
    try:
        data, header = _read_header(file, size, path, keys)
    except OSError as error:
        file.close()
        raise _unreadable(path, error) from None
    except BaseException:
        file.close()
        raise
    return OpenBundle(file, path, data, header)


def is_whole(path: Path) -> bool:
    """Whether waiting for more bytes is of no use: a copy under way is not refused as cut off."""
    try:
        file, size = _open(path)
    except BundleRefused:
        return True
    try:
        with file:
            head = file.read(HEAD.size)
    except OSError:
        return True
    if len(head) < HEAD.size:
        return False
    magic, _, _, total = HEAD.unpack(head)
    return bool(magic != MAGIC or size >= total)


def check_device(header: BundleHeader, device: Device, name: Path) -> None:
    """BundleRefused if a signed bundle is not for this device, now."""
    if _numbers(header.runtime_min) > _numbers(device.runtime):
        raise BundleRefused(
            f"{name}: needs mapvo {header.runtime_min}, this device has {device.runtime}; "
            "update the device first"
        )
    if device.site and header.site != device.site:
        raise BundleRefused(
            f"{name}: is for site {header.site}, this device is at {device.site}; "
            "take the bundle of this site"
        )
    if device.vocabulary is not None and header.vocabulary != device.vocabulary:
        raise BundleRefused(
            f"{name}: its words are of another vocabulary than this device's; build the map "
            "with the same version of mapvo"
        )
    if header.calibrations is not None and device.calibration not in header.calibrations:
        ours = "unknown" if device.calibration is None else device.calibration[:12]
        raise BundleRefused(
            f"{name}: is not for this device's camera (calibration {ours}); make it for that, "
            "or calibrate as it was"
        )
    _check_expiry(header, device, name)


def encode_head(header: bytes, carried_bytes: int) -> bytes:
    """The first bytes of a bundle; the signature is over these, the key id and the header."""
    total = HEAD.size + SEAL.size + len(header) + carried_bytes
    return HEAD.pack(MAGIC, CONTAINER_VERSION, len(header), total)


def _check_expiry(header: BundleHeader, device: Device, name: Path) -> None:
    if header.expires_utc is None or device.now is None:
        return
    try:
        expires = datetime.fromisoformat(header.expires_utc).astimezone(UTC)
    except (ValueError, OverflowError):
        raise BundleRefused(f"{name}: its expiry is no date; make the bundle again") from None
    if device.now >= expires:
        raise BundleRefused(
            f"{name}: expired on {header.expires_utc}, and this device's clock says "
            f"{device.now:%Y-%m-%d %H:%M}; take a newer bundle, or set the clock"
        )


def _open(path: Path) -> tuple[BinaryIO, int]:
    try:
        file = open_regular(path)
    except OSError as error:
        raise BundleRefused(f"{path}: cannot be opened: {error.strerror}; copy it again") from None
    return file, os.fstat(file.fileno()).st_size


def _unreadable(path: Path, error: OSError) -> BundleRefused:
    return BundleRefused(f"{path}: cannot be read: {error.strerror}; copy it again")


def _read_header(
    file: BinaryIO, size: int, path: Path, keys: TrustedKeys
) -> tuple[bytes, BundleHeader]:
    head = file.read(HEAD.size)
    if len(head) < HEAD.size or head[: len(MAGIC)] != MAGIC:
        raise BundleRefused(f"{path}: is no bundle; make one with mapvo-map bundle")
    _, version, length, total = HEAD.unpack(head)
    if version != CONTAINER_VERSION:
        raise BundleRefused(
            f"{path}: is a bundle of form {version}, this program reads {CONTAINER_VERSION}; "
            "update the device"
        )
    begin = HEAD.size + SEAL.size + length
    if length > MAX_HEADER_BYTES or begin > size:
        raise BundleRefused(f"{path}: its header is cut off or too large; copy it again")
    if total != size:
        raise BundleRefused(f"{path}: has {size} bytes instead of {total}; copy it again")
    signer, signature = SEAL.unpack(file.read(SEAL.size))
    data = file.read(length)
    keys.check(signer.hex(), signature, head + signer + data, path)
    header = _decode(data, path)
    if begin + sum(entry.bytes for entry in header.files if entry.carried) != size:
        raise BundleRefused(f"{path}: its files are not as long as it says; make it again")
    return data, header


def _decode(data: bytes, path: Path) -> BundleHeader:
    try:
        header = msgspec.json.decode(data, type=BundleHeader)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise BundleRefused(f"{path}: its header is damaged ({error}); make it again") from None
    names = [entry.path for entry in header.files]
    proper = header.format == FORMAT and names[0] == "manifest.json" and header.files[0].carried
    if not proper or len(set(names)) != len(names):
        raise BundleRefused(f"{path}: its header does not describe a map; make it again")
    return header


def _numbers(version: str) -> tuple[int, ...]:
    numbers = [int(part) for part in version.split("+")[0].split(".") if part.isdigit()]
    return tuple(numbers + [0] * (4 - len(numbers)))
