# SPDX-License-Identifier: Apache-2.0
from pathlib import Path

import msgspec
import pytest

from edge.errors import BundleRefused, OutputError, StoreError
from edge.store.trust import KeyStatement, TrustedKeys
from maps.bundle_keys import NewKey, make_key, rotate_key
from maps.cli import main
from tests.edge.store.made_bundles import Workstation


@pytest.fixture
def keys(tmp_path: Path) -> tuple[TrustedKeys, NewKey]:
    """A device that trusts one key, and that key."""
    (tmp_path / "etc").mkdir()
    key = make_key(tmp_path / "old.pem")
    key.public.rename(tmp_path / "etc" / "site.pub")
    return TrustedKeys([tmp_path / "etc", tmp_path / "own"]), key


def test_private_keys_are_for_their_owner_alone_and_never_replaced(tmp_path: Path) -> None:
    key = make_key(tmp_path / "site.pem")
    assert key.private.stat().st_mode & 0o077 == 0
    with pytest.raises(OutputError, match="never replaced"):
        make_key(tmp_path / "site.pem")


def test_a_new_key_comes_by_the_old_ones_word(
    keys: tuple[TrustedKeys, NewKey], tmp_path: Path
) -> None:
    trusted, old = keys
    new = make_key(tmp_path / "new.pem")
    assert set(trusted.load()) == {old.id}
    statement = rotate_key(old.private, new.private, retire=False)
    assert "is trusted" in trusted.follow(statement)
    assert set(trusted.load()) == {old.id, new.id}


def test_a_retired_key_is_never_trusted_again(
    keys: tuple[TrustedKeys, NewKey], tmp_path: Path
) -> None:
    trusted, old = keys
    new = make_key(tmp_path / "new.pem")
    trusted.follow(rotate_key(old.private, new.private, retire=True))
    assert set(trusted.load()) == {new.id}
    with pytest.raises(BundleRefused, match="does not trust"):
        trusted.follow(rotate_key(old.private, make_key(tmp_path / "x.pem").private, retire=False))
    with pytest.raises(BundleRefused, match="no key that may be trusted"):
        trusted.follow(rotate_key(new.private, old.private, retire=False))


def test_a_statement_that_is_not_there_is_said_to_be_missing(
    keys: tuple[TrustedKeys, NewKey], tmp_path: Path
) -> None:
    with pytest.raises(BundleRefused, match=r"gone\.mapvokeys: cannot be read: No such file"):
        keys[0].follow(tmp_path / "gone.mapvokeys")


def test_a_key_that_cannot_be_kept_is_refused_in_words(
    keys: tuple[TrustedKeys, NewKey], tmp_path: Path
) -> None:
    trusted, old = keys
    new = make_key(tmp_path / "new.pem")
    (tmp_path / "own" / f"{new.id}.pub").mkdir(parents=True)
    with pytest.raises(StoreError, match="own: the key cannot be kept: Is a directory"):
        trusted.follow(rotate_key(old.private, new.private, retire=False))


def test_bundles_of_a_retired_key_are_refused(tmp_path: Path) -> None:
    bench = Workstation(tmp_path / "bench")
    path = bench.bundle(1)
    trusted = TrustedKeys([bench.folder / "trusted", tmp_path / "own"])
    new = make_key(tmp_path / "new.pem")
    trusted.follow(rotate_key(bench.key.private, new.private, retire=True))
    bench.keys = trusted
    with pytest.raises(BundleRefused, match="does not trust"):
        bench.open(path)


def test_a_changed_statement_is_refused(keys: tuple[TrustedKeys, NewKey], tmp_path: Path) -> None:
    trusted, old = keys
    path = rotate_key(old.private, make_key(tmp_path / "new.pem").private, retire=False)
    said = msgspec.json.decode(path.read_bytes(), type=KeyStatement)
    mine = make_key(tmp_path / "mine.pem")
    for changed in (
        msgspec.structs.replace(said, retire=True),
        msgspec.structs.replace(said, trust=mine.public.read_text()),
        msgspec.structs.replace(said, signer=mine.id),
        msgspec.structs.replace(said, signature=""),
        msgspec.structs.replace(said, signature="no hex"),
    ):
        path.write_bytes(msgspec.json.encode(changed))
        with pytest.raises(BundleRefused):
            trusted.follow(path)
    for noise in (b"", b"[" * 4000, b'{"trust": 1}', b"\xff"):
        path.write_bytes(noise)
        with pytest.raises(BundleRefused, match="no statement"):
            trusted.follow(path)
    assert set(trusted.load()) == {old.id}


def test_what_is_no_key_is_passed_over(keys: tuple[TrustedKeys, NewKey], tmp_path: Path) -> None:
    trusted, old = keys
    (tmp_path / "etc" / "noise.pub").write_bytes(b"noise")
    (tmp_path / "etc" / "folder.pub").mkdir()
    (tmp_path / "etc" / "gone.pub").symlink_to("nowhere")
    (tmp_path / "etc" / "private.pub").write_bytes(old.private.read_bytes())
    assert set(trusted.load()) == {old.id}


def test_the_command_line_makes_and_rotates_keys(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    old, new = tmp_path / "old.pem", tmp_path / "new.pem"
    assert main(["key", "new", str(old)]) == 0
    assert main(["key", "new", str(new)]) == 0
    assert main(["key", "rotate", str(old), str(new), "--retire"]) == 0
    assert "new.mapvokeys" in capsys.readouterr().out
    assert main(["key", "rotate", str(tmp_path / "none.pem"), str(new)]) == 2
