# SPDX-License-Identifier: Apache-2.0
import hashlib
import os
import shutil
from pathlib import Path

import msgspec
import pytest

from edge.config import Config
from edge.geometry.camera import CameraModel
from edge.geometry.camera_text import camera_toml
from edge.runtime.doctor import examine, is_fit
from edge.runtime.doctor_host import Account, Grade, Host
from edge.runtime.doctor_models import check_models
from edge.runtime.warm_up import MAP_FOLDER
from edge.store.store import Store
from edge.tiles.reader import read_manifest
from tests.edge.cameras.recordings import write_tum
from tests.edge.runtime.made_host import ROOMY, MadeHost, look, worst
from tests.edge.store.made_bundles import RUNTIME, Workstation
from tests.maps.small_map import edited_manifest

SYSTEMD = Path(__file__).parents[3] / "systemd"
CAMERA = CameraModel(640, 480, 500.0, 500.0, 319.5, 239.5)


@pytest.fixture
def made(tmp_path: Path) -> MadeHost:
    return MadeHost(tmp_path)


def _camera_settings(
    made: MadeHost, device: str, identity: str = "", **v4l2: object
) -> dict[str, object]:
    made.write("/etc/camera.toml", camera_toml(CAMERA, 30.0, identity))
    camera = {
        "source": "v4l2",
        "calibration": "/etc/camera.toml",
        "v4l2": {"device": device} | v4l2,
    }
    return {"camera": camera}


def test_a_healthy_machine_is_fit_and_says_so_in_each_line(made: MadeHost) -> None:
    device = made.plug_camera()
    identity = f"path:{Path(device).name} serial:A1"
    findings = look(made, _camera_settings(made, device, identity, formats=["GREY"]))
    assert is_fit(findings)
    for subject in (
        "camera",
        "camera access",
        "USB",
        "calibration",
        "memory",
        "supply",
        "governor",
    ):
        assert worst(findings, subject).grade is Grade.GOOD, subject
    assert all(bool(f.remedy) != (f.grade is Grade.GOOD) for f in findings)


def test_a_camera_that_is_missing_names_those_that_are_there(made: MadeHost) -> None:
    made.plug_camera(serial="B2")
    found = worst(look(made, _camera_settings(made, "", serial="A1")), "camera")
    assert found.grade is Grade.BAD
    assert "serial:B2" in found.remedy


def test_a_device_that_may_not_be_opened_names_the_group(made: MadeHost) -> None:
    device = made.plug_camera(mode=0o660)
    findings = look(made, _camera_settings(made, device))
    access = worst(findings, "camera access")
    assert access.grade is Grade.BAD
    assert "usermod -aG" in access.remedy
    own_group = os.stat(made.tree.dev / "video0").st_gid  # noqa: PTH116
    allowed = Host(made.root, Account(uid=4321, groups=frozenset({own_group})))
    config = msgspec.convert(_camera_settings(made, device), Config)
    assert worst(examine(config, allowed, lambda _: ROOMY), "camera access").grade is Grade.GOOD


@pytest.mark.parametrize(
    ("speed", "formats", "grade"),
    [
        ("480", ["GREY"], Grade.GOOD),
        ("480", ["YUYV"], Grade.GOOD),
        ("12", ["GREY", "MJPG"], Grade.BAD),
        ("5000", ["GREY"], Grade.GOOD),
        ("100", ["YUYV", "MJPG"], Grade.DOUBTFUL),
    ],
)
def test_a_bus_that_is_too_slow_is_noticed(
    made: MadeHost, speed: str, formats: list[str], grade: Grade
) -> None:
    device = made.plug_camera(speed=speed)
    assert worst(look(made, _camera_settings(made, device, formats=formats)), "USB").grade is grade


def test_a_calibration_of_another_camera_or_size_or_none_is_bad(made: MadeHost) -> None:
    device = made.plug_camera(serial="B2")
    other = _camera_settings(made, device, "path:elsewhere serial:A1")
    assert "calibration of path:elsewhere" in worst(look(made, other), "calibration").found
    size = _camera_settings(made, device, width=320, height=240)
    assert "is for 640x480" in worst(look(made, size), "calibration").found
    none = {"camera": {"source": "v4l2", "v4l2": {"device": device}}}
    assert worst(look(made, none), "calibration").grade is Grade.BAD
    unbound = worst(look(made, _camera_settings(made, device)), "calibration")
    assert unbound.grade is Grade.DOUBTFUL


def test_an_oak_on_a_slow_bus_and_without_a_rule_is_noticed(made: MadeHost) -> None:
    device = "/sys/bus/usb/devices/2-1"
    values = {"idVendor": "03e7", "idProduct": "f63b", "serial": "1844", "speed": "480"}
    for name, text in (values | {"busnum": "2", "devnum": "7"}).items():
        made.write(f"{device}/{name}", text)
    made.write("/dev/bus/usb/002/007", "", mode=0o600)
    findings = look(made, {"camera": {"source": "oak"}})
    assert worst(findings, "camera").found.startswith("OAK 1844")
    assert worst(findings, "USB").grade is Grade.DOUBTFUL
    rule = worst(findings, "camera access").remedy.removeprefix("udev rule ")
    assert f"{rule}\n" in (SYSTEMD / "60-mapvo.rules").read_text()  # the installer's own
    shutil.rmtree(made.root / "sys/bus")
    assert worst(look(made, {"camera": {"source": "oak"}}), "camera").grade is Grade.BAD


def test_a_recording_is_looked_at(made: MadeHost, tmp_path: Path) -> None:
    recording = write_tum(tmp_path / "recording")
    assert (
        "6 frames" in worst(look(made, {"camera": {"recording": str(recording)}}), "camera").found
    )
    assert worst(look(made, {"camera": {"recording": "/none"}}), "camera").grade is Grade.BAD


def test_a_map_is_opened_and_every_byte_checked(made: MadeHost) -> None:
    shutil.copytree(MAP_FOLDER, made.root / "map")
    settings = {"map": {"folder": "/map"}}
    assert "every byte checked" in worst(look(made, settings), "map").found
    (tile,) = (made.root / "map/tiles").iterdir()
    data = bytearray(tile.read_bytes())
    data[len(data) // 2] ^= 1
    tile.chmod(0o644)
    tile.write_bytes(data)
    assert worst(look(made, settings), "map").grade is Grade.BAD


def test_the_map_in_use_of_a_store_is_checked_too(made: MadeHost, tmp_path: Path) -> None:
    settings = {"tiles": {"store": "/store"}}
    assert "holds none yet" in worst(look(made, settings), "map").found
    bench, store = Workstation(tmp_path / "bench"), Store(made.root / "store", 0)
    with bench.open(bench.bundle(3)) as bundle:
        installed = store.install(bundle, RUNTIME)
    store.activate(installed)
    assert "/store: 1-" in worst(look(made, settings), "map").found
    tile = next((store.map_folder(installed) / "tiles").iterdir())
    data = bytearray(tile.read_bytes())
    data[-1] ^= 1
    tile.chmod(0o644)
    tile.write_bytes(data)
    finding = worst(look(made, settings), "map")
    assert finding.grade is Grade.BAD
    assert "mapvo tiles install" in finding.remedy
    store.record(1).write_bytes(b"")
    finding = worst(look(made, settings), "map")
    assert finding.grade is Grade.BAD
    assert "is damaged" in finding.found


def write_onnx(path: Path, producer: bytes) -> str:
    """A model without a node, which has an outline; returns its hash."""
    data = b"\x12" + bytes([len(producer)]) + producer + b"\x3a\x00"
    path.write_bytes(data)
    return hashlib.sha256(data).hexdigest()


@pytest.mark.parametrize(
    ("table", "key", "subject"),
    [("relocalise", "features", "features"), ("segmenter", "model", "model")],
)
def test_a_model_must_be_there_and_that_of_the_map(
    made: MadeHost, table: str, key: str, subject: str
) -> None:
    shutil.copytree(MAP_FOLDER, made.root / "map")
    for file in (made.root / "map").rglob("*"):
        file.chmod(0o755)
    settings = {"map": {"folder": "/map"}, table: {key: "/a.onnx"}}
    assert "No such file" in worst(look(made, settings), subject).found
    (made.root / "a.onnx").write_bytes(b"words")
    assert "is no ONNX file" in worst(look(made, settings), subject).found
    sha256 = write_onnx(made.root / "a.onnx", b"a")
    without = worst(look(made, settings), subject)
    assert f"--{'features' if subject == 'features' else 'segmenter'} /a.onnx" in without.remedy
    with edited_manifest(made.root / "map") as manifest:
        tile = manifest["tiles"][0] | {"path": "tiles/other.tile"}
        manifest["labels"] = {"model": "a.onnx", "sha256": sha256, "names": ["mug"]}
        manifest["learned"] = {
            "model": "a.onnx",
            "sha256": sha256,
            "extractor": manifest["extractor"],
            "vocabulary": {"path": "tiles/w.tile", "bytes": 1, "sha256": sha256, "words": 1},
            "counts": manifest["counts"],
            "tiles": [tile],
        }
    map_ = read_manifest(made.root / "map")
    config = msgspec.convert(settings, Config)
    (finding,) = check_models(made.host, config, map_)
    assert finding.grade is Grade.GOOD
    write_onnx(made.root / "a.onnx", b"b")
    (finding,) = check_models(made.host, config, map_)
    assert finding.grade is not Grade.GOOD
    assert "is not the a.onnx that" in finding.found


def test_an_unknown_family_of_markers_names_the_known(made: MadeHost) -> None:
    finding = worst(look(made, {"markers": {"family": "9X9_50"}}), "markers")
    assert finding.grade is Grade.BAD
    assert "4X4_50" in finding.remedy


def test_a_name_without_a_root_is_one_from_here(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(MAP_FOLDER.parent)
    config = msgspec.convert({"map": {"folder": MAP_FOLDER.name}}, Config)
    assert worst(examine(config, Host(), lambda _: ROOMY), "map").grade is Grade.GOOD


def test_a_serial_line_is_looked_at(made: MadeHost) -> None:
    settings = {"outputs": {"serial": {"device": "/dev/serial/by-id/fc", "protocol": "ascii"}}}
    gone = worst(look(made, settings), "serial")
    assert gone.grade is Grade.BAD
    made.write("/dev/ttyACM0", "", mode=0o660)
    link = made.root / "dev/serial/by-id/fc"
    link.parent.mkdir(parents=True)
    link.symlink_to(made.root / "dev/ttyACM0")
    assert "usermod" in worst(look(made, settings), "serial").remedy
    (made.root / "dev/ttyACM0").chmod(0o666)
    assert worst(look(made, settings), "serial").grade is Grade.GOOD
    assert "of 921600 baud" in worst(look(made, settings), "serial budget").found
    made.write("/proc/77/comm", "ModemManager\n")
    assert worst(look(made, settings), "serial").grade is Grade.DOUBTFUL


def test_a_key_that_others_can_read_is_bad(made: MadeHost) -> None:
    curve = {"secret_key": "/etc/device.key", "clients": "/etc/clients"}
    settings = {"outputs": {"zmq": {"curve": curve}}}
    assert "is missing" in worst(look(made, settings), "keys").found
    key = made.write("/etc/device.key", "k", mode=0o644)
    assert "chmod 600" in worst(look(made, settings), "keys").remedy
    key.chmod(0o600)
    assert worst(look(made, settings), "keys").grade is Grade.GOOD
