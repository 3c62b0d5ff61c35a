# SPDX-License-Identifier: Apache-2.0
from pathlib import Path

import pytest

from edge.errors import OutputError, TileError
from edge.store.bundle import BundleHeader, open_bundle
from edge.store.trust import TrustedKeys
from edge.tiles.manifest import camera_entry
from maps.bundle import BundleOrder, bundle, version_now
from maps.bundle_keys import make_key
from maps.cli import main
from tests.maps.small_map import write_small_map
from tests.maps.wall_drive import CAMERA


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A map, and a key beside it."""
    make_key(tmp_path / "key.pem")
    return write_small_map(tmp_path / "map").folder


def header_of(path: Path) -> BundleHeader:
    with open_bundle(path, TrustedKeys([path.parent])) as opened:
        return opened.header


def order(site: str = "hall", version: int = 1) -> BundleOrder:
    return BundleOrder(site=site, map_version=version, untested=True)


def test_the_same_map_gives_the_same_bytes(folder: Path, tmp_path: Path) -> None:
    for name in ("a", "b"):
        bundle(folder, tmp_path / "key.pem", tmp_path / f"{name}.mapbundle", order())
    assert (tmp_path / "a.mapbundle").read_bytes() == (tmp_path / "b.mapbundle").read_bytes()


def test_versions_rise_by_themselves() -> None:
    assert 20260101000000 < version_now() < 1 << 62


def test_a_map_that_cannot_be_localised_in_is_not_sent(folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "a.mapbundle"
    with pytest.raises(TileError, match="held-out keyframes are found"):
        bundle(folder, tmp_path / "key.pem", out, BundleOrder(site="hall", map_version=1))
    assert not out.exists()


def test_a_damaged_map_is_not_sent(folder: Path, tmp_path: Path) -> None:
    tile = next((folder / "tiles").iterdir())
    data = bytearray(tile.read_bytes())
    data[-1] ^= 1
    tile.write_bytes(data)
    with pytest.raises(TileError):
        bundle(folder, tmp_path / "key.pem", tmp_path / "a.mapbundle", order())


def test_impossible_orders_are_refused(folder: Path, tmp_path: Path) -> None:
    for wrong in (order(site="../etc"), order(version=0), order(version=1 << 63)):
        with pytest.raises(OutputError, match="cannot be bundled"):
            bundle(folder, tmp_path / "key.pem", tmp_path / "a.mapbundle", wrong)


def test_a_failed_write_keeps_the_old_bundle(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "a.mapbundle").mkdir()
    with pytest.raises(OutputError, match="cannot be written"):
        bundle(folder, tmp_path / "key.pem", tmp_path / "a.mapbundle", order())
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "a.mapbundle",
        "key.pem",
        "key.pub",
        "map",
    ]


def test_the_command_says_for_whom(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    camera = tmp_path / "camera.toml"
    camera.write_text(
        f"width = {CAMERA.width}\nheight = {CAMERA.height}\nfx = {CAMERA.fx}\nfy = {CAMERA.fy}\n"
        f'cx = {CAMERA.cx}\ncy = {CAMERA.cy}\ndistortion_model = "none"\ndistortion = []\n'
        "rate_hz = 30.0\n"
    )
    out = tmp_path / "a.mapbundle"
    options = f"--key {tmp_path}/key.pem --out {out} --site hall --map-version 7 --untested"
    more = f"--camera {camera} --expires 2030-01-31"
    assert main(["bundle", str(folder), *options.split(), *more.split()]) == 0
    assert "site hall, version 7" in capsys.readouterr().out
    header = header_of(out)
    assert header.expires_utc == "2030-01-31T00:00:00+00:00"
    assert header.calibrations == [camera_entry(CAMERA).id]
    with pytest.raises(SystemExit, match="2"):
        main(["bundle", str(folder), *options.split(), "--expires", "soon"])
