# SPDX-License-Identifier: Apache-2.0
"""The doctor on cameras: there, open to us, quick enough, and calibrated."""

from importlib.util import find_spec
from pathlib import Path

from edge.cameras.binding import check_binding
from edge.cameras.recording import open_recording
from edge.cameras.v4l2_identity import DeviceTree, Identity
from edge.config.camera import CameraConfig
from edge.errors import EdgeError
from edge.geometry.camera import CameraFile, load_camera_file
from edge.runtime.doctor_host import Finding, Host, bad, doubtful, good

_LUXONIS = "03e7"
_OAK_RULE = f'SUBSYSTEM=="usb", ATTR{{idVendor}}=="{_LUXONIS}", GROUP="video", MODE="0660"'
_FULL_SPEED, _HIGH_SPEED, _SUPER_SPEED = 12.0, 480.0, 5000.0  # Mbit/s
_USABLE = 0.7  # of a bus, for images
_BITS = {"GREY": 8, "YUYV": 16, "NV12": 12, "MJPG": 2}  # a pixel


def check_camera(host: Host, config: CameraConfig) -> list[Finding]:
    """Everything about the camera of the settings."""
    if config.source == "recording":
        return [_recording(config)]
    if config.source == "oak":
        return [*_oak(host), *_calibration(host, config, None)]
    found, identity = _v4l2(host, config)
    return [*found, *_calibration(host, config, identity)]


def _recording(config: CameraConfig) -> Finding:
    if not config.recording:
        return doubtful(
            "camera",
            "none is configured",
            "set camera.source to v4l2 or oak (`mapvo config --defaults` prints all keys)",
        )
    try:
        recording = open_recording(config.recording)
    except EdgeError as error:
        return bad("camera", str(error), "name a recording in camera.recording")
    return good("camera", f"recording {config.recording}, {len(recording)} frames")


def _tree(host: Host) -> DeviceTree:
    return DeviceTree(host.path("/dev"), host.path("/sys"))


def _v4l2(host: Host, config: CameraConfig) -> tuple[list[Finding], Identity | None]:
    settings, tree = config.v4l2, _tree(host)
    if not settings.device and not settings.serial:
        names = ", ".join(one.by_path for one in tree.all()) or "no camera is plugged in"
        remedy = f"set it to one of /dev/v4l/by-path/: {names}"
        return [bad("camera", "camera.v4l2.device is empty", remedy)], None
    device = str(host.path(settings.device)) if settings.device else ""
    try:
        identity = tree.find(device, settings.serial)
    except EdgeError as error:
        there = ", ".join(one.key for one in tree.all()) or "none"
        return [bad("camera", str(error), f"plug it in; plugged in now: {there}")], None
    node = Path(identity.node)
    findings = [good("camera", f"{node.name}, {identity.key}")]
    if refusal := host.refusal(node):
        findings.append(bad("camera access", f"{node.name} may not be opened", refusal))
    else:
        findings.append(good("camera access", f"{host.account.name} may open {node.name}"))
    return [*findings, *_usb(host, node.name, config)], identity


def _usb(host: Host, node: str, config: CameraConfig) -> list[Finding]:
    """Whether the bus carries the images."""
    interface = host.path(f"/sys/class/video4linux/{node}/device")
    try:
        speed = float((interface.resolve().parent / "speed").read_text())
    except (OSError, ValueError):
        return []  # no USB device: a ribbon cable has no such trouble
    settings = config.v4l2
    name = settings.formats[0]
    pixels = settings.width * settings.height * settings.rate_hz
    needed = {form: pixels * _BITS[form] / 1e6 for form in settings.formats}
    fits = [form for form in settings.formats if needed[form] <= _USABLE * speed]
    found = f"{speed:g} Mbit/s, {name} needs {needed[name]:.0f}"
    if not fits:
        return [bad("USB", found, "use a USB 3 socket and cable, a smaller size or a lower rate")]
    if name not in fits:
        return [doubtful("USB", found, f"use a USB 3 socket and cable, or {fits[0]} is taken")]
    return [good("USB", found)]


def _oak(host: Host) -> list[Finding]:
    findings = []
    if find_spec("depthai") is None:
        findings.append(bad("depthai", "is not installed", "pip install 'mapvo[oak]'"))
    devices = [
        path.parent
        for path in host.glob("/sys/bus/usb/devices/*/idVendor")
        if path.read_text().strip() == _LUXONIS
    ]
    if not devices:
        return [*findings, bad("camera", "no OAK is plugged in", "plug it in, power it")]
    for device in devices:
        findings += _oak_device(host, device)
    return findings


def _oak_device(host: Host, device: Path) -> list[Finding]:
    def text(name: str) -> str:
        path = device / name
        return path.read_text().strip() if path.exists() else ""

    findings = [good("camera", f"OAK {text('serial')} at {device.name}")]
    speed = float(text("speed") or 0)
    if 0 < speed < _SUPER_SPEED and text("idProduct") != "2485":  # which is before it has booted
        remedy = "use a USB 3 socket and cable"
        findings.append(doubtful("USB", f"{speed:g} Mbit/s", remedy))
    node = host.path(f"/dev/bus/usb/{int(text('busnum') or 0):03d}/{int(text('devnum') or 0):03d}")
    if node.exists() and host.refusal(node):
        refused = f"{node.name} may not be opened"
        findings.append(bad("camera access", refused, f"udev rule {_OAK_RULE}"))
    return findings


def _calibration(host: Host, config: CameraConfig, identity: Identity | None) -> list[Finding]:
    if not config.calibration:
        if config.source == "oak":
            return [good("calibration", "the device's own")]
        remedy = "`mapvo record --uncalibrated` a board, `mapvo calibrate` it, name that"
        return [bad("calibration", "camera.calibration is empty", remedy)]
    try:
        file = load_camera_file(host.path(config.calibration))
        _check_size(file, config)
        if identity is not None:
            check_binding(file.identity, identity, _tree(host).all(), config.calibration)
    except EdgeError as error:
        return [bad("calibration", str(error), "`mapvo calibrate` this camera")]
    if not file.identity:
        remedy = "calibrate from `mapvo record`, which binds it"
        return [doubtful("calibration", f"{config.calibration} names no camera", remedy)]
    return [good("calibration", f"{config.calibration} of {file.identity}")]


def _check_size(file: CameraFile, config: CameraConfig) -> None:
    settings = config.v4l2 if config.source == "v4l2" else config.oak
    size = (file.camera.width, file.camera.height)
    if size != (settings.width, settings.height):
        raise EdgeError(
            f"{config.calibration} is for {size[0]}x{size[1]}, the camera is set to "
            f"{settings.width}x{settings.height}"
        )
