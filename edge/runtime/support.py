# SPDX-License-Identifier: Apache-2.0
"""Everything that helps to help, in one file, without secrets."""

import io
import os
import re
import shutil
import subprocess
import tarfile
import time
from collections.abc import Sequence
from pathlib import Path

import msgspec

from edge.config import Config
from edge.config.redaction import LEFT_OUT, without_secrets
from edge.errors import OutputError
from edge.runtime.doctor import to_lines
from edge.runtime.doctor_host import Finding, Host
from edge.runtime.versions import versions
from edge.store.durable import write_whole

_SYSTEM_FILES = (
    *("/etc/os-release", "/proc/cpuinfo", "/proc/meminfo", "/proc/loadavg", "/proc/uptime"),
    *("/proc/mounts", "/proc/asound/cards", "/sys/firmware/devicetree/base/model"),
)
_JOURNAL = ("journalctl", "--unit=mapvo*", "--lines=5000", "--output=short-monotonic", "--no-pager")
_JOURNAL_TIMEOUT_S = 20.0
_MAX_MANIFEST_BYTES = 5_000_000
_KEY_BLOCK = re.compile(r"-----BEGIN [^-]*-----.*?-----END [^-]*-----", re.DOTALL)
_SECRET_LINE = re.compile(r"(?im)^.*\b\w*(secret|passw|token|credential|private|serial\s*:)\w*.*$")


def write_bundle(
    out: Path, config: Config, findings: Sequence[Finding], host: Host, recording: bool
) -> list[str]:
    """Write `out` (tar.gz, for its owner only); returns the names of what is in it."""
    parts = _texts(config, findings, host)
    files = _newest_recordings(config, host) if recording else []
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w:gz") as archive:
        for name, text in parts.items():
            _add(archive, name, _without_names(text).encode())
        for path in files:
            _add(archive, f"recordings/{path.name}", path.read_bytes())
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        write_whole(out, buffer.getvalue(), 0o600)
    except OSError as error:
        raise OutputError(
            f"{out}: cannot be written: {error.strerror}; name another place with --out"
        ) from error
    return [*parts, *(f"recordings/{path.name}" for path in files)]


def scrub(text: str) -> str:
    """Without lines that may hold secrets."""
    return _SECRET_LINE.sub(LEFT_OUT, _KEY_BLOCK.sub(LEFT_OUT, text))


def _without_names(text: str) -> str:
    """Without what tells whose machine it is."""
    for word, stands_for in ((str(Path.home()), "~"), (os.uname().nodename, "HOST")):
        if len(word) > 3:  # a short one would be found in other words
            text = text.replace(word, stands_for)
    return text


def _texts(config: Config, findings: Sequence[Finding], host: Host) -> dict[str, str]:
    """Names and contents; what is not there is left out."""
    settings = msgspec.json.format(msgspec.json.encode(without_secrets(config)), indent=2)
    parts = {
        "doctor.txt": "\n".join(to_lines(findings)) + "\n",
        "versions.json": msgspec.json.encode(versions()).decode() + "\n",
        "settings.json": settings.decode() + "\n",
        "system.txt": scrub(
            "".join(f"--- {name}\n{text}\n" for name in _SYSTEM_FILES if (text := host.read(name)))
        ),
        "journal.txt": scrub(_journal()),
        "recordings.txt": _list(host.path(config.recorder.folder)) if _records(config) else "",
    }
    if config.camera.calibration and (text := host.read(config.camera.calibration)):
        parts["camera.toml"] = text
    manifest = host.path(config.map.folder) / "manifest.json" if config.map.folder else None
    if manifest and manifest.is_file() and manifest.stat().st_size < _MAX_MANIFEST_BYTES:
        parts["map-manifest.json"] = manifest.read_text(encoding="utf-8", errors="replace")
    return {name: text for name, text in parts.items() if text}


def _journal() -> str:
    """What the service has said lately."""
    if shutil.which(_JOURNAL[0]) is None:
        return ""
    try:
        done = subprocess.run(
            _JOURNAL, capture_output=True, timeout=_JOURNAL_TIMEOUT_S, check=False
        )
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return done.stdout.decode("utf-8", "replace")


def _records(config: Config) -> bool:
    return bool(config.recorder.folder)


def _list(folder: Path) -> str:
    rows = [
        f"{path.stat().st_size:12d}  {path.relative_to(folder)}\n"
        for path in sorted(folder.rglob("*.mcap"))
    ]
    return "".join(rows)


def _newest_recordings(config: Config, host: Host) -> list[Path]:
    """The last whole file of the ring, if there is one."""
    if not _records(config):
        return []
    folder = host.path(config.recorder.folder)
    files = sorted(folder.glob("*.mcap"), key=lambda path: path.stat().st_mtime_ns)
    return files[-2:-1] or files


def _add(archive: tarfile.TarFile, name: str, data: bytes) -> None:
    entry = tarfile.TarInfo(f"mapvo-support/{name}")
    entry.size, entry.mode = len(data), 0o600
    entry.mtime = int(time.clock_gettime(time.CLOCK_REALTIME))
    archive.addfile(entry, io.BytesIO(data))
