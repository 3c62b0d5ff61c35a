# SPDX-License-Identifier: Apache-2.0
import json
import os
import tarfile
from pathlib import Path

import pytest

from edge.cli import main
from edge.runtime.support import scrub
from tests.edge.capture.captures import write
from tests.edge.runtime.made_host import MadeHost

SECRET = "correct-horse-battery-staple"


@pytest.fixture
def made(tmp_path: Path) -> MadeHost:
    made = MadeHost(tmp_path / "root")
    made.write("/etc/mapvo/device.key", SECRET, mode=0o600)
    made.write("/etc/mapvo/clients", "")
    made.write("/etc/os-release", f"NAME=Test\nHOME={Path.home()}\nTOKEN={SECRET}\n")
    made.write("/proc/cpuinfo", "model name : Some\nSerial\t\t: 10000000abcd\n")
    made.write("/etc/camera.toml", "width = 640\n")
    write(made.write("/rec/x", "").parent / "a.mcap")
    write(made.root / "rec/b.mcap")
    return made


@pytest.fixture
def config(made: MadeHost, tmp_path: Path) -> Path:
    path = tmp_path / "mapvo.toml"
    path.write_text(
        '[camera]\ncalibration = "/etc/camera.toml"\nsource = "v4l2"\n'
        '[recorder]\nfolder = "/rec"\n'
        '[outputs.zmq.curve]\nsecret_key = "/etc/mapvo/device.key"\n'
        'clients = "/etc/mapvo/clients"\n'
    )
    return path


def _unpack(path: Path) -> dict[str, bytes]:
    with tarfile.open(path) as archive:
        return {
            Path(entry.name).name: archive.extractfile(entry).read()  # type: ignore[union-attr]
            for entry in archive
        }


def test_it_holds_what_helps_and_no_secret(made: MadeHost, config: Path, tmp_path: Path) -> None:
    out = tmp_path / "support.tar.gz"
    arguments = ["support", "--config", str(config), "--root", str(made.root), "--out", str(out)]
    assert main(arguments) == 0
    assert os.stat(out).st_mode & 0o777 == 0o600  # noqa: PTH116
    parts = _unpack(out)
    assert set(parts) >= {"doctor.txt", "versions.json", "settings.json", "system.txt"}
    assert parts["camera.toml"] == b"width = 640"
    settings = json.loads(parts["settings.json"])
    assert settings["outputs"]["zmq"]["curve"]["secret_key"] == "(left out)"
    system = parts["system.txt"]
    assert b"model name" in system
    for unwanted in (SECRET.encode() + b"\n", b"10000000abcd", str(Path.home()).encode() + b"\n"):
        assert unwanted not in system
    assert b"a.mcap" in parts["recordings.txt"]
    assert not any(name.endswith(".mcap") for name in parts)


def test_images_are_in_it_only_on_demand(made: MadeHost, config: Path, tmp_path: Path) -> None:
    out = tmp_path / "support.tar.gz"
    arguments = ["support", "--config", str(config), "--root", str(made.root), "--out", str(out)]
    assert main([*arguments, "--recording"]) == 0
    assert "a.mcap" in _unpack(out)  # the newest may still be written to


@pytest.mark.parametrize(
    "text",
    [
        f"-----BEGIN PRIVATE KEY-----\n{SECRET}\n-----END PRIVATE KEY-----",
        f"password = {SECRET}",
        f"event=login ApiToken: {SECRET}",
        f"  MAPVO_SECRET={SECRET}",
    ],
)
def test_lines_that_may_hold_secrets_are_left_out(text: str) -> None:
    cleaned = scrub(f"before\n{text}\nafter\n")
    assert SECRET not in cleaned
    assert cleaned.startswith("before\n")
    assert cleaned.endswith("after\n")
