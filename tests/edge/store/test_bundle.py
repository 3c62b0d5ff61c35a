# SPDX-License-Identifier: Apache-2.0
"""Bundles from people who mean harm, from broken sticks and for other devices."""

import io
import os
import random
import tarfile
import tracemalloc
import zipfile
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import msgspec
import pytest

from edge.errors import BundleRefused
from edge.store.bundle import (
    HEAD,
    MAX_HEADER_BYTES,
    SEAL,
    OpenBundle,
    encode_head,
    is_whole,
    open_bundle,
)
from edge.store.store import Store
from edge.store.trust import key_id
from maps.bundle import BundleOrder
from maps.bundle_keys import make_key
from maps.signing import load_private_key
from tests.edge.store.made_bundles import RUNTIME, Workstation

Header = dict[str, Any]


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Workstation:
    return Workstation(tmp_path_factory.mktemp("bench") / "bench")


@pytest.fixture(scope="module")
def good(bench: Workstation) -> bytes:
    return bench.bundle(1).read_bytes()


# The first byte of a process's memory is never there: the kernel answers as for a broken stick.
UNREADABLE = Path("/proc/self/mem")


@pytest.fixture
def store(tmp_path: Path) -> Store:
    store = Store(tmp_path / "device" / "store")
    store.create()
    return store


def everything(folder: Path) -> set[tuple[Path, int]]:
    """All files and links below a folder."""
    found = (path for path in folder.rglob("*") if not path.is_dir() and path.name != "lock")
    return {(path, path.lstat().st_size) for path in found}


def refused(bench: Workstation, store: Store, path: Path, match: str | None = None) -> None:
    """The bundle is refused in one line that names it, and leaves no trace."""
    device = store.root.parent
    before = everything(device)
    with pytest.raises(BundleRefused, match=match) as caught, bench.open(path) as bundle:
        store.install(bundle, RUNTIME)
    assert path.name in str(caught.value)
    assert "\n" not in str(caught.value)
    assert all(store.objects in left.parents for left, _ in everything(device) - before)
    store.collect()
    assert everything(device) == before


def signed(bench: Workstation, header: bytes, payload: bytes, carried: int | None = None) -> bytes:
    """A bundle that the trusted key has signed, whatever it says."""
    private = load_private_key(bench.key.private)
    head = encode_head(header, len(payload) if carried is None else carried)
    signer = bytes.fromhex(key_id(private.public_key()))
    return head + SEAL.pack(signer, private.sign(head + signer + header)) + header + payload


def parts(data: bytes) -> tuple[Header, bytes]:
    """Header and payload of a good bundle."""
    begin = HEAD.size + SEAL.size
    length = HEAD.unpack_from(data)[2]
    return msgspec.json.decode(data[begin : begin + length]), data[begin + length :]


def test_a_good_bundle_gives_a_map_that_verifies(
    bench: Workstation, store: Store, good: bytes, tmp_path: Path
) -> None:
    (tmp_path / "good.mapbundle").write_bytes(good)
    with bench.open(tmp_path / "good.mapbundle") as bundle:
        generation = store.install(bundle, RUNTIME)
    assert store.verify(generation) == sum(entry.bytes for entry in bundle.header.files)
    assert store.linked("current") is None


def test_cut_off_anywhere_it_is_refused(
    bench: Workstation, store: Store, good: bytes, tmp_path: Path
) -> None:
    begin = HEAD.size + SEAL.size
    fields = [0, 1, 8, 12, 16, HEAD.size, HEAD.size + 32, begin, begin + 1, len(good) - 1]
    path = tmp_path / "cut.mapbundle"
    for length in [*fields, *random.Random(1).sample(range(len(good)), 20)]:
        path.write_bytes(good[:length])
        refused(bench, store, path)
        assert not is_whole(path)


def test_any_flipped_bit_is_found(
    bench: Workstation, store: Store, good: bytes, tmp_path: Path
) -> None:
    rng = random.Random(2)
    begin = HEAD.size + SEAL.size
    places = [*range(0, begin, 5), *(rng.randrange(begin, len(good)) for _ in range(30))]
    path = tmp_path / "flipped.mapbundle"
    for place in places:
        data = bytearray(good)
        data[place] ^= 1 << rng.randrange(8)
        path.write_bytes(data)
        refused(bench, store, path)


def test_a_stranger_cannot_sign_it_again(bench: Workstation, store: Store, tmp_path: Path) -> None:
    stranger = make_key(tmp_path / "stranger.pem")
    path = bench.bundle(77, seed=1, key=stranger)
    refused(bench, store, path, "does not trust")


def with_path(name: str) -> Callable[[Header], None]:
    def change(header: Header) -> None:
        header["files"][-1]["path"] = name

    return change


def _twice(header: Header) -> None:
    header["files"][-1]["path"] = header["files"][-2]["path"]


def _no_manifest(header: Header) -> None:
    header["files"] = header["files"][1:]


def _too_many(header: Header) -> None:
    header["files"] = [header["files"][0]] * 70_000


def _huge_file(header: Header) -> None:
    header["files"][-1]["bytes"] = 1 << 39


def _other_format(header: Header) -> None:
    header["format"] = "zip"


def _bad_site(header: Header) -> None:
    header["site"] = "../../etc"


@pytest.mark.parametrize(
    "change",
    [
        with_path("../../etc/passwd"),
        with_path("/etc/passwd"),
        with_path("tiles/../../x.tile"),
        with_path("tiles/a/b.tile"),
        with_path("tiles/x.tile\n"),
        with_path("tiles/x\0.tile"),
        with_path("tiles/X.tile"),
        with_path("current"),
        _twice,
        _no_manifest,
        _too_many,
        _huge_file,
        _other_format,
        _bad_site,
    ],
)
def test_a_signature_makes_no_hostile_header_good(
    bench: Workstation, store: Store, good: bytes, tmp_path: Path, change: Callable[[Header], None]
) -> None:
    header, payload = parts(good)
    change(header)
    path = tmp_path / "hostile.mapbundle"
    path.write_bytes(signed(bench, msgspec.json.encode(header), payload))
    refused(bench, store, path)


@pytest.mark.parametrize(
    "header", [b"", b"null", b"[" * 100_000, b'{"files":' * 1000, b"\xff\xfe", b'{"format": 1}']
)
def test_a_signed_header_that_is_none_is_refused(
    bench: Workstation, store: Store, tmp_path: Path, header: bytes
) -> None:
    path = tmp_path / "none.mapbundle"
    path.write_bytes(signed(bench, header, b""))
    refused(bench, store, path)


def test_a_manifest_that_names_other_tiles_is_refused(
    bench: Workstation, store: Store, good: bytes, tmp_path: Path
) -> None:
    header, payload = parts(good)
    header["files"][-1]["path"] = "tiles/another.tile"
    path = tmp_path / "other.mapbundle"
    path.write_bytes(signed(bench, msgspec.json.encode(header), payload))
    refused(bench, store, path, "no map that opens")


def test_archives_and_noise_are_no_bundles(
    bench: Workstation, store: Store, tmp_path: Path
) -> None:
    path = tmp_path / "bomb.mapbundle"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("tiles/a.tile", bytes(50_000_000))
    refused(bench, store, path, "no bundle")
    with tarfile.open(path, "w") as archive:
        entry = tarfile.TarInfo("../../etc/passwd")
        entry.type = tarfile.SYMTYPE
        archive.addfile(entry, io.BytesIO())
    refused(bench, store, path, "no bundle")
    path.write_bytes(random.Random(3).randbytes(5000))
    refused(bench, store, path, "no bundle")


def test_links_pipes_devices_and_folders_are_refused_without_reading(
    bench: Workstation, store: Store, good: bytes, tmp_path: Path
) -> None:
    (tmp_path / "real.mapbundle").write_bytes(good)
    (tmp_path / "link.mapbundle").symlink_to("real.mapbundle")
    (tmp_path / "endless.mapbundle").symlink_to("/dev/zero")
    (tmp_path / "folder.mapbundle").mkdir()
    os.mkfifo(tmp_path / "pipe.mapbundle")
    for name in ("link", "endless", "folder", "pipe"):
        refused(bench, store, tmp_path / f"{name}.mapbundle")


@pytest.mark.parametrize("length", [MAX_HEADER_BYTES + 1, 0xFFFFFFFF])
def test_a_gigantic_header_costs_neither_memory_nor_time(
    bench: Workstation, store: Store, good: bytes, tmp_path: Path, length: int
) -> None:
    path = tmp_path / "giant.mapbundle"
    magic, version, _, _ = HEAD.unpack_from(good)
    with path.open("wb") as file:  # sparse: it takes no room
        file.write(HEAD.pack(magic, version, length, 1 << 40))
        file.truncate(1 << 40)
    tracemalloc.start()
    refused(bench, store, path, "header")
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 4 << 20


def test_a_bundle_for_others_is_refused_with_the_reason(
    bench: Workstation, store: Store, tmp_path: Path
) -> None:
    expires = datetime(2026, 1, 1, tzinfo=UTC)
    path = bench.made(
        BundleOrder(site="hall", map_version=5, untested=True, runtime_min="2.1", expires=expires),
        seed=1,
    )
    device = replace(RUNTIME, now=datetime(2025, 1, 1, tzinfo=UTC))
    with bench.open(path) as bundle:
        for changed, match in (
            ({"runtime": "2.0.9"}, "needs mapvo 2.1"),
            ({"site": "yard"}, "site hall, this device is at yard"),
            ({"vocabulary": "0" * 64}, "another vocabulary"),
            ({"now": expires}, "expired"),
        ):
            with pytest.raises(BundleRefused, match=match):
                store.install(bundle, replace(device, **changed))  # type: ignore[arg-type]
        store.install(bundle, device)


def test_only_the_named_calibrations_may_take_it(
    bench: Workstation, store: Store, good: bytes, tmp_path: Path
) -> None:
    header, payload = parts(good)
    header["calibrations"] = ["a" * 64]
    path = tmp_path / "ours.mapbundle"
    path.write_bytes(signed(bench, msgspec.json.encode(header), payload))
    with open_bundle(path, bench.keys) as bundle:
        for calibration in (None, "b" * 64):
            with pytest.raises(BundleRefused, match="not for this device's camera"):
                store.install(bundle, replace(RUNTIME, calibration=calibration))
        store.install(bundle, replace(RUNTIME, calibration="a" * 64))


def test_a_disk_without_room_is_said_before_anything_is_written(
    bench: Workstation, tmp_path: Path
) -> None:
    full = Store(tmp_path / "store", keep_free_bytes=1 << 60)
    full.create()
    with bench.open(bench.bundle(1)) as bundle, pytest.raises(BundleRefused, match="MB"):
        full.install(bundle, RUNTIME)
    assert list(full.objects.iterdir()) == []


def test_a_stick_that_cannot_be_read_is_refused_in_words(bench: Workstation, good: bytes) -> None:
    assert is_whole(UNREADABLE)
    with pytest.raises(BundleRefused, match=r"mem: cannot be read: Input/output error"):
        bench.open(UNREADABLE)
    with bench.open(bench.bundle(1)) as bundle, UNREADABLE.open("rb", buffering=0) as broken:
        pulled_out = OpenBundle(broken, Path("a.mapbundle"), b"", bundle.header)
        with pytest.raises(BundleRefused, match=r"a\.mapbundle: cannot be read: Input/output"):
            list(pulled_out.read(bundle.header.files[0]))
