# SPDX-License-Identifier: Apache-2.0
"""What the store writes down: one record for each generation, and small notes beside them."""

from pathlib import Path
from typing import Annotated, TypeVar

import msgspec

from edge.errors import StoreError
from edge.store.bundle import BundleFile, BundleHeader, HeldOut

MAX_RECORD_BYTES = 32 << 20
_RECORD = "generation-"
_JSON = ".json"

S = TypeVar("S", bound=msgspec.Struct)


class StoredFile(msgspec.Struct, frozen=True):
    """One file of a map: its name there, and the object that it is."""

    path: str
    bytes: int
    sha256: str


class Generation(msgspec.Struct, frozen=True, kw_only=True):
    """An installed map; the record never changes."""

    number: Annotated[int, msgspec.Meta(ge=1)]
    bundle: str  # sha256 of the bundle's header
    site: str
    map_version: int
    expires_utc: str | None
    held_out: HeldOut
    files: list[StoredFile]

    @property
    def folder_name(self) -> str:
        """Name of the map's folder; differs for different maps even if numbers come again."""
        return f"{self.number}-{self.bundle[:12]}"

    @property
    def title(self) -> str:
        """What people call it."""
        return f"generation {self.number} (site {self.site}, version {self.map_version})"


class Trial(msgspec.Struct, frozen=True):
    """How often a generation that is not good yet was started with."""

    number: int
    starts: int


class Outcome(msgspec.Struct, frozen=True):
    """What became of the generation that somebody wanted to be used."""

    number: int
    ok: bool
    text: str


class Versions(msgspec.Struct, frozen=True):
    """What was ever installed, so that nothing older comes back."""

    highest: dict[str, int]  # by site


def record_name(number: int) -> str:
    """File name of a generation's record."""
    return f"{_RECORD}{number}{_JSON}"


def record_number(name: str) -> int | None:
    """Generation that a record's file name is of; None if it is no such name."""
    digits = name.removeprefix(_RECORD).removesuffix(_JSON)
    proper = digits.isascii() and digits.isdigit() and record_name(int(digits)) == name
    return int(digits) if proper else None


def record_of(number: int, bundle: str, header: BundleHeader) -> Generation:
    """The record of a bundle's map."""
    return Generation(
        number=number,
        bundle=bundle,
        site=header.site,
        map_version=header.map_version,
        expires_utc=header.expires_utc,
        held_out=header.held_out,
        files=[_stored(entry) for entry in header.files],
    )


def read_note(path: Path, kind: type[S], remedy: str = "remove the file") -> S | None:
    """Content of a JSON file of the store; None where there is none."""
    try:
        with path.open("rb") as file:
            data = file.read(MAX_RECORD_BYTES)
    except FileNotFoundError:
        return None
    except OSError as error:
        raise StoreError(f"{path}: cannot be read: {error.strerror}; check the disk") from None
    try:
        return msgspec.json.decode(data, type=kind)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise StoreError(f"{path}: is damaged ({error}); check the disk, then {remedy}") from None


def _stored(entry: BundleFile) -> StoredFile:
    return StoredFile(entry.path, entry.bytes, entry.sha256)
