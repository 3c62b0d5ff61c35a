# SPDX-License-Identifier: Apache-2.0
"""What runs here: versions and machine, for recordings and reports."""

import os
import platform
import time
from importlib.metadata import PackageNotFoundError, version

import msgspec

from edge import __version__
from edge.capture.format import Header
from edge.config import Config
from edge.config.redaction import without_secrets
from edge.geometry.camera import CameraModel
from edge.geometry.camera_text import camera_toml

_PACKAGES = (
    *("numpy", "numba", "scipy", "opencv-python-headless", "msgspec", "pyzmq", "pyserial"),
    *("mcap", "onnxruntime", "depthai"),
)


def versions() -> dict[str, str]:
    """Versions of everything that results may depend on; what is not installed is left out."""
    found = {
        "mapvo": __version__,
        "python": platform.python_version(),
        "kernel": platform.release(),
        "machine": platform.machine(),
    }
    for package in _PACKAGES:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            continue
    return found


def recording_header(
    camera: CameraModel | None, rate_hz: float, identity: str, config: Config | None
) -> Header:
    """Header of a recording that begins now; without a camera it is one to calibrate with."""
    started = time.strftime("%Y%m%dT%H%M%SZ", time.gmtime())
    info = {
        "mapvo": __version__,
        "versions": msgspec.json.encode(versions()).decode(),
        "started_utc": started,
        "identity": identity,
        "rate_hz": repr(float(rate_hz)),
    }
    if config is not None:
        info["settings"] = msgspec.json.encode(without_secrets(config)).decode()
    # The clock may be wrong before it is set, and two may begin within a second.
    session = f"{started}-{os.getpid()}-{time.monotonic_ns() % 1_000_000:06d}"
    text = "" if camera is None else camera_toml(camera, rate_hz, identity)
    return Header(text, session, 0, info)
