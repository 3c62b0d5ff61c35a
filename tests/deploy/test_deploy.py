# SPDX-License-Identifier: Apache-2.0
"""What is installed on devices: scripts, units, settings. Installing is checked by deploy/*.sh."""

import os
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from edge.config import load_config

DEPLOY = Path(__file__).parents[2] / "deploy"
SYSTEMD = DEPLOY.parent / "systemd"
TOOLS = DEPLOY.parent / "tools"
SCRIPTS = [*sorted(DEPLOY.glob("*.sh")), DEPLOY / "mapvo.command"]
SCRIPTS += [TOOLS / name for name in ("install", "demo", "check")]


def program(name: str) -> str:
    """Path of a program, beside this Python or anywhere; the test is skipped without it."""
    beside = Path(sys.executable).with_name(name)
    found = str(beside) if beside.exists() else shutil.which(name)
    if found is None:
        pytest.skip(f"needs {name}")
    return found


def test_scripts_have_nothing_that_shellcheck_minds() -> None:
    command = [program("shellcheck"), *map(str, SCRIPTS)]
    said = subprocess.run(command, check=False, capture_output=True, text=True)
    assert said.stdout == ""


@pytest.mark.slow
def test_the_unit_is_sound_and_tight() -> None:
    program("systemd-analyze")
    said = subprocess.run([DEPLOY / "check-units.sh"], check=False, capture_output=True, text=True)
    assert said.returncode == 0, said.stderr
    exposure = re.search(r"service: ([0-9.]+)", said.stdout)
    assert exposure is not None
    assert float(exposure[1]) <= 2.0


def test_the_settings_that_are_installed_are_good() -> None:
    tiles = load_config(DEPLOY / "mapvo.toml").tiles
    assert tiles.store == "/var/lib/mapvo/store"
    unit = (SYSTEMD / "mapvo.service").read_text()
    rules = (SYSTEMD / "60-mapvo.rules").read_text()
    for inbox in tiles.inboxes:
        assert f"ReadWritePaths=-{inbox}\n" in unit
        assert f"$devnode {inbox}" in rules


def test_what_is_plugged_in_after_the_start_may_be_opened() -> None:
    unit = (SYSTEMD / "mapvo.service").read_text()
    modules = {"video4linux": "videodev", "ttyACM": "cdc_acm", "ttyUSB": "usbserial"}
    for group, module in modules.items():
        assert f"DeviceAllow=char-{group} rw\n" in unit
        for key in ("Wants", "After"):
            assert re.search(rf"(?m)^{key}=.*\bmodprobe@{module}\.service\b", unit), module


def test_the_installer_brings_all_that_it_names() -> None:
    text = (DEPLOY / "install.sh").read_text()
    named = set(re.findall(r"source_of ([\w.-]+)\)", text))
    for listed in re.findall(r"for file in (.*?); do", text, re.DOTALL):
        named |= set(listed.replace("\\", " ").split())
    assert {"mapvo.service", "network.conf"} <= named
    for name in named:
        assert any((folder / name).is_file() for folder in (DEPLOY, SYSTEMD)), name


def test_the_way_back_brings_back_that_versions_unit(tmp_path: Path) -> None:
    text = (DEPLOY / "install.sh").read_text()
    places = r"(?<=[\s=])(/opt/mapvo|/etc/\w+|/run/systemd|/usr/l\w+)"
    (tmp_path / "install.sh").write_text(re.sub(places, rf"{tmp_path}\1", text))
    (tmp_path / "bin").mkdir()
    (tmp_path / "bin" / "id").write_text("#!/bin/sh\necho 0\n")  # as root
    (tmp_path / "bin" / "id").chmod(0o755)
    (tmp_path / "usr" / "local" / "bin").mkdir(parents=True)
    versions = tmp_path / "opt" / "mapvo" / "versions"
    for name in ("old", "new"):
        (versions / name / "bin").mkdir(parents=True)
        (versions / name / "units").mkdir()
        for file in ("mapvo.command", "mapvo.service", "mapvo.tmpfiles", "60-mapvo.rules"):
            (versions / name / "units" / file).write_text(f"{file} of the {name} one\n")
    (tmp_path / "opt" / "mapvo" / "current").symlink_to(versions / "new")
    (tmp_path / "opt" / "mapvo" / "previous").symlink_to(versions / "old")
    path = f"{tmp_path / 'bin'}:{os.environ['PATH']}"
    command = ["sh", tmp_path / "install.sh", "--back"]
    subprocess.run(command, check=True, env={"PATH": path})
    for file in ("etc/systemd/system/mapvo.service", "usr/lib/udev/rules.d/60-mapvo.rules"):
        assert "of the old one" in (tmp_path / file).read_text()
    assert (tmp_path / "opt" / "mapvo" / "previous").readlink() == versions / "new"


def test_guides_lead_to_files_that_are_there() -> None:
    for guide in DEPLOY.glob("*.md"):
        for target in re.findall(r"\]\(([^)#]+)\)", guide.read_text()):
            assert (DEPLOY / target).exists(), f"{guide.name}: {target}"


def test_a_stick_is_mounted_by_options_that_exfat_knows_as_well_as_vfat() -> None:
    rules = (SYSTEMD / "60-mapvo.rules").read_text()
    options = re.search(r"--options=(\S+)", rules)
    assert options is not None
    names = {option.partition("=")[0] for option in options[1].split(",")}
    # flush, quiet, tz and others are of vfat alone: exfat would not be mounted at all.
    assert names <= {"nosuid", "nodev", "noexec", "noatime", "uid", "gid", "umask"}


def test_the_installer_builds_from_all_that_a_wheel_is_made_of() -> None:
    copied = re.search(r"for part in (.*?); do", (DEPLOY / "install.sh").read_text())
    assert copied is not None
    table = tomllib.loads((DEPLOY.parent / "pyproject.toml").read_text())
    project, packages = table["project"], table["tool"]["setuptools"]["packages"]["find"]["include"]
    needed = {"pyproject.toml", project["readme"], *project["license-files"]}
    needed |= {name.rstrip("*") for name in packages}
    assert set(copied[1].split()) == needed
