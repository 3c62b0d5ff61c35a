# SPDX-License-Identifier: Apache-2.0
import hashlib
import os
import shutil
from pathlib import Path

import msgspec
import pytest

from edge.cli import main
from edge.config import Config
from edge.geometry.camera import CameraModel
from edge.geometry.camera_text import camera_toml
from edge.runtime.doctor import examine, is_fit, to_lines
from edge.runtime.doctor_host import Account, Finding, Grade, Host
from edge.runtime.doctor_models import check_models
from edge.runtime.warm_up import MAP_FOLDER
from edge.tiles.reader import read_manifest
from tests.edge.cameras.recordings import write_tum
from tests.edge.runtime.made_host import MadeHost
from tests.maps.small_map import edited_manifest

ROOMY = 10**12
CAMERA = CameraModel(640, 480, 500.0, 500.0, 319.5, 239.5)


@pytest.fixture
def made(tmp_path: Path) -> MadeHost:
    return MadeHost(tmp_path)


def _find(
    made: MadeHost, settings: dict[str, object] | None = None, room: int = ROOMY
) -> list[Finding]:
    config = msgspec.convert(settings or {}, Config)
    return examine(config, made.host, room=lambda _: room)


def _of(findings: list[Finding], subject: str) -> Finding:
    """The worst finding about a subject."""
    order = [Grade.GOOD, Grade.DOUBTFUL, Grade.BAD]
    about = [finding for finding in findings if finding.subject == subject]
    assert about, to_lines(findings)
    return max(about, key=lambda finding: order.index(finding.grade))


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
    findings = _find(made, _camera_settings(made, device, identity, formats=["GREY"]))
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
        assert _of(findings, subject).grade is Grade.GOOD, subject
    assert all(bool(f.remedy) != (f.grade is Grade.GOOD) for f in findings)


def test_a_camera_that_is_missing_names_those_that_are_there(made: MadeHost) -> None:
    made.plug_camera(serial="B2")
    found = _of(_find(made, _camera_settings(made, "", serial="A1")), "camera")
    assert found.grade is Grade.BAD
    assert "serial:B2" in found.remedy


def test_a_device_that_may_not_be_opened_names_the_group(made: MadeHost) -> None:
    device = made.plug_camera(mode=0o660)
    findings = _find(made, _camera_settings(made, device))
    access = _of(findings, "camera access")
    assert access.grade is Grade.BAD
    assert "usermod -aG" in access.remedy
    own_group = os.stat(made.tree.dev / "video0").st_gid  # noqa: PTH116
    allowed = Host(made.root, Account(uid=4321, groups=frozenset({own_group})))
    config = msgspec.convert(_camera_settings(made, device), Config)
    assert _of(examine(config, allowed, lambda _: ROOMY), "camera access").grade is Grade.GOOD


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
    assert _of(_find(made, _camera_settings(made, device, formats=formats)), "USB").grade is grade


def test_a_calibration_of_another_camera_or_size_or_none_is_bad(made: MadeHost) -> None:
    device = made.plug_camera(serial="B2")
    other = _camera_settings(made, device, "path:elsewhere serial:A1")
    assert "calibration of path:elsewhere" in _of(_find(made, other), "calibration").found
    size = _camera_settings(made, device, width=320, height=240)
    assert "is for 640x480" in _of(_find(made, size), "calibration").found
    none = {"camera": {"source": "v4l2", "v4l2": {"device": device}}}
    assert _of(_find(made, none), "calibration").grade is Grade.BAD
    unbound = _of(_find(made, _camera_settings(made, device)), "calibration")
    assert unbound.grade is Grade.DOUBTFUL


def test_an_oak_on_a_slow_bus_and_without_a_rule_is_noticed(made: MadeHost) -> None:
    device = "/sys/bus/usb/devices/2-1"
    values = {"idVendor": "03e7", "idProduct": "f63b", "serial": "1844", "speed": "480"}
    for name, text in (values | {"busnum": "2", "devnum": "7"}).items():
        made.write(f"{device}/{name}", text)
    made.write("/dev/bus/usb/002/007", "", mode=0o600)
    findings = _find(made, {"camera": {"source": "oak"}})
    assert _of(findings, "camera").found.startswith("OAK 1844")
    assert _of(findings, "USB").grade is Grade.DOUBTFUL
    assert "udev rule" in _of(findings, "camera access").remedy
    shutil.rmtree(made.root / "sys/bus")
    assert _of(_find(made, {"camera": {"source": "oak"}}), "camera").grade is Grade.BAD


def test_a_recording_is_looked_at(made: MadeHost, tmp_path: Path) -> None:
    recording = write_tum(tmp_path / "recording")
    assert "6 frames" in _of(_find(made, {"camera": {"recording": str(recording)}}), "camera").found
    assert _of(_find(made, {"camera": {"recording": "/none"}}), "camera").grade is Grade.BAD


@pytest.mark.parametrize(
    ("name", "text", "subject", "grade"),
    [
        ("/sys/class/thermal/thermal_zone0/temp", "73000", "temperature", Grade.DOUBTFUL),
        ("/sys/class/thermal/thermal_zone0/temp", "85000", "temperature", Grade.BAD),
        ("/sys/class/hwmon/hwmon1/in0_lcrit_alarm", "1", "supply", Grade.BAD),
        ("/proc/meminfo", "MemAvailable: 500000 kB", "memory", Grade.DOUBTFUL),
        ("/proc/meminfo", "MemAvailable: 200000 kB", "memory", Grade.BAD),
        (
            *("/sys/devices/system/cpu/cpu2/cpufreq/scaling_governor", "powersave", "governor"),
            Grade.DOUBTFUL,
        ),
        (
            *("/sys/devices/system/clocksource/clocksource0/current_clocksource", "hpet"),
            *("clock source", Grade.DOUBTFUL),
        ),
    ],
)
def test_trouble_of_the_machine_is_found(
    made: MadeHost, name: str, text: str, subject: str, grade: Grade
) -> None:
    made.write(name, text)
    assert _of(_find(made), subject).grade is grade


@pytest.mark.parametrize(
    ("report", "grade"),
    [("0", Grade.GOOD), ("50005", Grade.BAD), ("50000", Grade.DOUBTFUL), ("e0000", Grade.DOUBTFUL)],
)
def test_a_raspberrys_own_report_is_read(made: MadeHost, report: str, grade: Grade) -> None:
    shutil.rmtree(made.root / "sys/class/hwmon")
    made.write("/sys/devices/platform/soc/soc:firmware/get_throttled", report)
    assert _of(_find(made), "supply").grade is grade


def test_a_clock_that_nobody_keeps_is_noticed(made: MadeHost) -> None:
    (made.root / "run/systemd/timesync/synchronized").unlink()
    assert _of(_find(made), "clock").grade is Grade.DOUBTFUL
    made.write("/sys/class/rtc/rtc0/name", "rtc")
    assert _of(_find(made), "clock").grade is Grade.GOOD


@pytest.mark.parametrize(
    ("room_mb", "grade"), [(50, Grade.BAD), (500, Grade.DOUBTFUL), (5000, Grade.GOOD)]
)
def test_a_disk_that_is_nearly_full_is_noticed(made: MadeHost, room_mb: int, grade: Grade) -> None:
    assert _of(_find(made, room=room_mb * 10**6), "disk").grade is grade


def test_a_recorder_needs_the_room_that_it_leaves_to_others(made: MadeHost) -> None:
    settings = {"recorder": {"folder": "/rec", "min_free_mb": 800.0}}
    assert _of(_find(made, settings, room=700_000_000), "recorder").grade is Grade.BAD


def test_a_map_is_opened_and_every_byte_checked(made: MadeHost) -> None:
    shutil.copytree(MAP_FOLDER, made.root / "map")
    settings = {"map": {"folder": "/map"}}
    assert "every byte checked" in _of(_find(made, settings), "map").found
    (tile,) = (made.root / "map/tiles").iterdir()
    data = bytearray(tile.read_bytes())
    data[len(data) // 2] ^= 1
    tile.chmod(0o644)
    tile.write_bytes(data)
    assert _of(_find(made, settings), "map").grade is Grade.BAD


def test_the_map_in_use_of_a_store_is_checked_too(made: MadeHost) -> None:
    settings = {"tiles": {"store": "/store"}}
    assert "holds none yet" in _of(_find(made, settings), "map").found
    shutil.copytree(MAP_FOLDER, made.root / "store/maps/3")
    (made.root / "store/current").symlink_to("maps/3")
    assert "/store: 3: " in _of(_find(made, settings), "map").found
    (tile,) = (made.root / "store/maps/3/tiles").iterdir()
    data = bytearray(tile.read_bytes())
    data[-1] ^= 1
    tile.chmod(0o644)
    tile.write_bytes(data)
    finding = _of(_find(made, settings), "map")
    assert finding.grade is Grade.BAD
    assert "mapvo tiles install" in finding.remedy


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
    assert "No such file" in _of(_find(made, settings), subject).found
    (made.root / "a.onnx").write_bytes(b"words")
    assert "is no ONNX file" in _of(_find(made, settings), subject).found
    sha256 = write_onnx(made.root / "a.onnx", b"a")
    without = _of(_find(made, settings), subject)
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
    finding = _of(_find(made, {"markers": {"family": "9X9_50"}}), "markers")
    assert finding.grade is Grade.BAD
    assert "4X4_50" in finding.remedy


def test_a_name_without_a_root_is_one_from_here(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(MAP_FOLDER.parent)
    config = msgspec.convert({"map": {"folder": MAP_FOLDER.name}}, Config)
    assert _of(examine(config, Host(), lambda _: ROOMY), "map").grade is Grade.GOOD


def test_a_serial_line_is_looked_at(made: MadeHost) -> None:
    settings = {"outputs": {"serial": {"device": "/dev/serial/by-id/fc", "protocol": "ascii"}}}
    gone = _of(_find(made, settings), "serial")
    assert gone.grade is Grade.BAD
    made.write("/dev/ttyACM0", "", mode=0o660)
    link = made.root / "dev/serial/by-id/fc"
    link.parent.mkdir(parents=True)
    link.symlink_to(made.root / "dev/ttyACM0")
    assert "usermod" in _of(_find(made, settings), "serial").remedy
    (made.root / "dev/ttyACM0").chmod(0o666)
    assert _of(_find(made, settings), "serial").grade is Grade.GOOD
    assert "of 921600 baud" in _of(_find(made, settings), "serial budget").found
    made.write("/proc/77/comm", "ModemManager\n")
    assert _of(_find(made, settings), "serial").grade is Grade.DOUBTFUL


def test_a_key_that_others_can_read_is_bad(made: MadeHost) -> None:
    curve = {"secret_key": "/etc/device.key", "clients": "/etc/clients"}
    settings = {"outputs": {"zmq": {"curve": curve}}}
    assert "is missing" in _of(_find(made, settings), "keys").found
    key = made.write("/etc/device.key", "k", mode=0o644)
    assert "chmod 600" in _of(_find(made, settings), "keys").remedy
    key.chmod(0o600)
    assert _of(_find(made, settings), "keys").grade is Grade.GOOD


def test_a_check_that_fails_itself_hides_no_other(made: MadeHost) -> None:
    made.write("/proc/meminfo", "MemAvailable: nonsense")
    findings = _find(made)
    assert "cannot be looked at: ValueError" in _of(findings, "system").found
    assert _of(findings, "camera").grade is Grade.DOUBTFUL


def test_the_exit_status_says_whether_it_will_work(
    made: MadeHost, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    made.write("/proc/meminfo", "MemAvailable: 100000 kB")
    assert main(["doctor", "--root", str(made.root)]) == 1
    assert "bad   memory" in capsys.readouterr().out
    config = tmp_path / "c.toml"
    config.write_text("[camera]\nsource = 3\n")
    assert main(["doctor", "--config", str(config)]) == 2
