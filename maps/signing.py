# SPDX-License-Identifier: Apache-2.0
"""Signs a map: Ed25519 over the manifest, which names the hash of every other file."""

from pathlib import Path

from cryptography.exceptions import InvalidSignature, UnsupportedAlgorithm
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric import ed25519

from edge.errors import OutputError, TileError
from edge.store import durable
from edge.tiles import manifest as manifest_format
from edge.tiles.reader import read_manifest
from maps.verification import verify

SIGNATURE_NAME = "manifest.sig"
_MAKE_KEY = "make one with: mapvo-map key new FILE"
_TAKE_PUBLIC = "take it from a private key with: openssl pkey -in KEY -pubout -out FILE"


def sign(folder: Path, key: Path) -> Path:
    """Write the signature of a map that is in order; return its file."""
    verify(folder)
    private = load_private_key(key)
    target = folder / SIGNATURE_NAME
    try:
        signature = private.sign((folder / manifest_format.FILE_NAME).read_bytes())
        durable.write_whole(target, signature)
    except OSError as error:
        raise OutputError(f"{target}: cannot be written ({error.strerror})") from None
    return target


def load_private_key(key: Path) -> ed25519.Ed25519PrivateKey:
    """The Ed25519 private key in a PEM file; OutputError says why it is none."""
    try:
        private = serialization.load_pem_private_key(_read_key(key), password=None)
    except (ValueError, TypeError, UnsupportedAlgorithm):
        raise OutputError(f"{key}: is no private key without a password; {_MAKE_KEY}") from None
    if not isinstance(private, ed25519.Ed25519PrivateKey):
        raise OutputError(f"{key}: is no Ed25519 key; {_MAKE_KEY}")
    return private


def check_signature(folder: Path, public_key: Path) -> None:
    """TileError unless the map's manifest was signed with the private half of this key."""
    read_manifest(folder)
    try:
        public = serialization.load_pem_public_key(_read_key(public_key))
    except (ValueError, UnsupportedAlgorithm):
        raise OutputError(f"{public_key}: is no public key; {_TAKE_PUBLIC}") from None
    if not isinstance(public, ed25519.Ed25519PublicKey):
        raise OutputError(f"{public_key}: is no Ed25519 key; {_TAKE_PUBLIC}")
    path = folder / SIGNATURE_NAME
    try:
        signature = path.read_bytes()
    except OSError:
        raise TileError(f"{folder}: is not signed; sign it with mapvo-map sign") from None
    try:
        public.verify(signature, (folder / manifest_format.FILE_NAME).read_bytes())
    except InvalidSignature:
        raise TileError(f"{path}: was not made with this key for this map; sign it again") from None


def _read_key(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise OutputError(f"{path}: cannot be read ({error.strerror}); give a key file") from None
