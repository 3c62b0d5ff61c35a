# SPDX-License-Identifier: Apache-2.0
"""Which keys the device believes: Ed25519 public keys, each a PEM file in one of a few folders."""

import hashlib
import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import msgspec
from cryptography.exceptions import InvalidSignature, UnsupportedAlgorithm
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric import ed25519

from edge.errors import BundleRefused, StoreError
from edge.store import durable
from edge.store.regular import open_regular, read_start

KEY_SUFFIX = ".pub"
STATEMENT_SUFFIX = ".mapvokeys"
STATEMENT_DOMAIN = b"mapvo keys 1\0"  # so that no signature of one thing serves for another
_MAX_BYTES = 4096  # of a key or a statement
_MAX_KEYS = 256

KeyId = Annotated[str, msgspec.Meta(pattern=r"^[0-9a-f]{64}\Z")]

log = logging.getLogger(__name__)


class KeyStatement(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A new key, and perhaps the end of the old one, said by who holds the old one."""

    trust: str  # PEM of the new public key
    retire: bool  # the signing key is not to be believed from now on
    signer: KeyId
    signature: str = ""  # hex; over STATEMENT_DOMAIN and the JSON of all this with an empty one


def key_id(public: ed25519.Ed25519PublicKey) -> str:
    """Name of a key: the sha256 of its 32 bytes."""
    raw = public.public_bytes(serialization.Encoding.Raw, serialization.PublicFormat.Raw)
    return hashlib.sha256(raw).hexdigest()


def statement_bytes(statement: KeyStatement) -> bytes:
    """What the signature of a statement is over."""
    return STATEMENT_DOMAIN + msgspec.json.encode(msgspec.structs.replace(statement, signature=""))


def public_key(data: bytes) -> ed25519.Ed25519PublicKey | None:
    """The Ed25519 key in a PEM file; None if it is anything else."""
    try:
        key = serialization.load_pem_public_key(data)
    except (ValueError, UnsupportedAlgorithm):
        return None
    return key if isinstance(key, ed25519.Ed25519PublicKey) else None


class TrustedKeys:
    """The keys in some folders: `*.pub`. New ones go to the last folder, the store's own.

    A key that was retired stays so, whichever folder still holds it: its id is the name of a
    file in `retired` of the last folder.
    """

    def __init__(self, folders: Sequence[Path]) -> None:
        self._folders = tuple(folders)

    def load(self) -> dict[str, ed25519.Ed25519PublicKey]:
        """Keys by id, as they are on the disk now."""
        keys = {}
        for path in self._files():
            key = public_key(read_start(path, _MAX_BYTES, follow=True))
            if key is None:
                log.warning("event=key_unreadable file=%s remedy=replace or remove it", path)
            elif not self._is_retired(key_id(key)):
                keys[key_id(key)] = key
        return keys

    def check(self, signer: str, signature: bytes, data: bytes, what: Path) -> None:
        """BundleRefused unless `data` was signed by the trusted key `signer`."""
        keys = self.load()
        if signer not in keys:
            known = ", ".join(name[:12] for name in sorted(keys)) or "none"
            raise BundleRefused(
                f"{what}: is signed by key {signer[:12]}, which this device does not trust "
                f"(it trusts {known}); put its .pub file into {self._folders[0]}"
            )
        try:
            keys[signer].verify(signature, data)
        except InvalidSignature:
            raise BundleRefused(
                f"{what}: its signature is wrong; copy it again, or have it made again"
            ) from None

    def follow(self, what: Path) -> str:
        """Carry out the signed statement about keys in a file; return what was done."""
        try:
            with open_regular(what) as file:
                data = file.read(_MAX_BYTES)
        except OSError as error:
            raise BundleRefused(
                f"{what}: cannot be read: {error.strerror}; copy it again"
            ) from None
        try:
            statement = msgspec.json.decode(data, type=KeyStatement)
            signature = bytes.fromhex(statement.signature)
        except (msgspec.MsgspecError, UnicodeDecodeError, ValueError, RecursionError):
            raise BundleRefused(
                f"{what}: is no statement about keys; make one with mapvo-map key rotate"
            ) from None
        self.check(statement.signer, signature, statement_bytes(statement), what)
        new = public_key(statement.trust.encode())
        if new is None or self._is_retired(key_id(new)):
            raise BundleRefused(f"{what}: names no key that may be trusted; make a new one")
        try:
            return self._carry_out(statement, key_id(new))
        except OSError as error:
            raise StoreError(
                f"{self._folders[-1]}: the key cannot be kept: {error.strerror}; "
                "check space and rights"
            ) from None

    def _carry_out(self, statement: KeyStatement, new: str) -> str:
        own = self._folders[-1]
        durable.make_folder(own)
        durable.write_whole(own / f"{new}{KEY_SUFFIX}", statement.trust.encode())
        done = f"key {new[:12]} is trusted"
        if statement.retire and statement.signer != new:
            durable.make_folder(own / "retired")
            durable.write_whole(own / "retired" / statement.signer, b"")
            done += f", key {statement.signer[:12]} no longer"
        return done

    def _files(self) -> list[Path]:
        files = []
        for folder in self._folders:
            if folder.is_dir():
                files += sorted(path for path in folder.iterdir() if path.suffix == KEY_SUFFIX)
        return files[:_MAX_KEYS]

    def _is_retired(self, name: str) -> bool:
        return (self._folders[-1] / "retired" / name).exists()
