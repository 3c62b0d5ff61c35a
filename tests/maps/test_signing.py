# SPDX-License-Identifier: Apache-2.0
from pathlib import Path

import pytest
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric import ec, ed25519

from edge.errors import OutputError, TileError
from edge.tiles.reader import open_map
from maps.cli import main
from maps.signing import check_signature, sign
from tests.maps.small_map import edited_manifest, write_small_map

PEM = serialization.Encoding.PEM


def write_keys(folder: Path, name: str = "key") -> tuple[Path, Path]:
    private = ed25519.Ed25519PrivateKey.generate()
    files = folder / f"{name}.pem", folder / f"{name}.pub"
    files[0].write_bytes(
        private.private_bytes(PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption())
    )
    files[1].write_bytes(
        private.public_key().public_bytes(PEM, serialization.PublicFormat.SubjectPublicKeyInfo)
    )
    return files


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_small_map(tmp_path / "small").folder


def test_a_signed_map_is_known_by_its_key_and_still_opens(folder: Path, tmp_path: Path) -> None:
    private, public = write_keys(tmp_path)
    assert sign(folder, private).stat().st_size == 64
    check_signature(folder, public)
    open_map(folder, verify=True)


def test_another_key_or_another_manifest_is_found_out(folder: Path, tmp_path: Path) -> None:
    private, public = write_keys(tmp_path)
    sign(folder, private)
    with pytest.raises(TileError, match="not made with this key"):
        check_signature(folder, write_keys(tmp_path, "other")[1])
    with edited_manifest(folder) as manifest:
        manifest["frame"] = "hall"
    with pytest.raises(TileError, match="not made with this key"):
        check_signature(folder, public)


def test_an_unsigned_map_is_said_to_be_so(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(TileError, match="not signed"):
        check_signature(folder, write_keys(tmp_path)[1])


def test_a_damaged_map_is_not_signed(folder: Path, tmp_path: Path) -> None:
    tile = open_map(folder).tiles[0].path
    data = bytearray(tile.read_bytes())
    data[-1] ^= 1
    tile.write_bytes(data)
    with pytest.raises(TileError, match=str(tile)):
        sign(folder, write_keys(tmp_path)[0])
    assert not (folder / "manifest.sig").exists()


@pytest.mark.parametrize("content", [None, b"", b"no key", "elliptic"])
def test_a_file_that_is_no_such_key_is_refused(
    folder: Path, tmp_path: Path, content: bytes | str | None
) -> None:
    path = tmp_path / "wrong.pem"
    if content == "elliptic":
        content = ec.generate_private_key(ec.SECP256R1()).private_bytes(
            PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
        )
    if isinstance(content, bytes):
        path.write_bytes(content)
    for use in (sign, check_signature):
        with pytest.raises(OutputError, match=str(path)):
            use(folder, path)


def test_the_commands_sign_and_verify(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    private, public = write_keys(tmp_path)
    assert main(["verify", str(folder), "--public-key", str(public)]) == 2
    assert "not signed" in capsys.readouterr().err
    assert main(["sign", str(folder), "--key", str(private)]) == 0
    assert main(["verify", str(folder), "--public-key", str(public)]) == 0
    assert "signed with this key" in capsys.readouterr().out
