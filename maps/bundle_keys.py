# SPDX-License-Identifier: Apache-2.0
"""Makes keys for maps and bundles, and the statements by which devices change them."""

import os
from pathlib import Path
from typing import NamedTuple

import msgspec
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric import ed25519

from edge.errors import OutputError
from edge.store import durable
from edge.store.trust import KEY_SUFFIX, STATEMENT_SUFFIX, KeyStatement, key_id, statement_bytes
from maps.signing import load_private_key

_PEM = serialization.Encoding.PEM
_PRIVATE = 0o600


class NewKey(NamedTuple):
    """Files of a key."""

    private: Path
    public: Path
    id: str


def make_key(private: Path) -> NewKey:
    """Write a new private key and, beside it, the public one that devices trust."""
    key = ed25519.Ed25519PrivateKey.generate()
    public = private.with_suffix(KEY_SUFFIX)
    secret = key.private_bytes(
        _PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
    try:
        _write_new(private, secret, _PRIVATE)
        _write_new(public, _public_pem(key), 0o644)
    except OSError as error:
        raise OutputError(
            f"{private}: cannot be written ({os.strerror(error.errno or 0)}); keys are never "
            "replaced, so choose another name or place"
        ) from None
    return NewKey(private, public, key_id(key.public_key()))


def rotate_key(old: Path, new: Path, retire: bool) -> Path:
    """Write a statement by the old key that the new one is to be trusted; return its file."""
    signer, trusted = load_private_key(old), load_private_key(new)
    statement = KeyStatement(
        trust=_public_pem(trusted).decode(), retire=retire, signer=key_id(signer.public_key())
    )
    signature = signer.sign(statement_bytes(statement)).hex()
    signed = msgspec.structs.replace(statement, signature=signature)
    out = new.with_suffix(STATEMENT_SUFFIX)
    try:
        durable.write_whole(out, msgspec.json.format(msgspec.json.encode(signed), indent=1) + b"\n")
    except OSError as error:
        raise OutputError(f"{out}: cannot be written ({error.strerror})") from None
    return out


def _public_pem(key: ed25519.Ed25519PrivateKey) -> bytes:
    return key.public_key().public_bytes(_PEM, serialization.PublicFormat.SubjectPublicKeyInfo)


def _write_new(path: Path, data: bytes, mode: int) -> None:
    durable.write_new(path, [data], mode)
    durable.sync_folder(path.parent)
