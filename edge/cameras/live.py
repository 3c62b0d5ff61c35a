# SPDX-License-Identifier: Apache-2.0
"""Opens the live camera that the settings name."""

import logging
import threading
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

from edge.cameras.binding import binding_of, check_binding
from edge.cameras.oak import OakCamera, device_calibration, oak_opener
from edge.cameras.plug_events import PlugEvents
from edge.cameras.reopen import LiveCamera, ReopeningCamera
from edge.cameras.v4l2 import V4l2Camera
from edge.cameras.v4l2_identity import DeviceTree
from edge.cameras.v4l2_kernel import Kernel
from edge.config.camera import CameraConfig
from edge.config.v4l2 import V4l2Config
from edge.errors import CameraLost, ConfigError
from edge.geometry.camera import CameraFile, CameraModel, load_camera_file
from edge.types import Frame

log = logging.getLogger(__name__)


class LiveSource:
    """A live camera for as long as the program runs: it is found again after each loss.

    Owned by one thread; `stop` may be called from any, by a signal handler too.
    """

    def __init__(
        self,
        camera: CameraModel,
        rate_hz: float,
        identity: str,
        open_camera: Callable[[], LiveCamera],
        events: PlugEvents | None = None,
        stopping: threading.Event | None = None,
    ) -> None:
        """`stopping` tells `open_camera` of a `stop` that comes while it opens the device."""
        self.identity = identity
        self._events = events or PlugEvents()
        self._stopping = stopping or threading.Event()
        self._reopening = ReopeningCamera(
            camera, rate_hz, open_camera, sleep=self._events.wait, now_ns=time.monotonic_ns
        )

    @property
    def camera(self) -> CameraModel:
        """Calibration of the images that come."""
        return self._reopening.camera

    @property
    def rate_hz(self) -> float:
        """Nominal frame rate."""
        return self._reopening.rate_hz

    @property
    def dropped(self) -> int:
        """Frames lost while a device was open."""
        return self._reopening.dropped

    @property
    def losses(self) -> int:
        """How often the device was lost."""
        return self._reopening.losses

    def __iter__(self) -> Iterator[Frame]:
        return iter(self._reopening)

    def stop(self) -> None:
        """Let iterating end soon."""
        self._stopping.set()
        self._reopening.stop()
        self._events.wake()

    def close(self) -> None:
        """Free what listens for devices; iterating must have ended."""
        self._events.close()


def open_live(
    config: CameraConfig,
    kernel: Kernel | None = None,
    tree: DeviceTree | None = None,
    *,
    colour: bool = False,
) -> LiveSource:
    """The camera of the settings, which need not be there yet; for a model, with `colour`.

    But an OAK without `calibration` must be, as the device itself has to say what that is.
    CameraRefused and ConfigError say what a person has to do.
    """
    if config.source == "v4l2":
        return _open_v4l2(config, kernel, tree or DeviceTree(), colour=colour)
    if config.source == "oak":
        return _open_oak(config, colour=colour)
    raise ConfigError("camera.source: 'recording' is no live camera: set v4l2 or oak")


def open_uncalibrated(
    config: CameraConfig, kernel: Kernel | None = None, tree: DeviceTree | None = None
) -> LiveSource:
    """The camera of the settings, to be recorded for its calibration; it must be there.

    Its `camera` holds for the size of the images only.
    """
    if config.source == "oak":
        oak = OakCamera(config.oak)
        opener = oak_opener(config.oak, oak.identity, "the recording", oak)
        model = _placeholder(config.oak.width, config.oak.height)
        return LiveSource(model, config.oak.rate_hz, oak.identity, opener)
    settings, devices = config.v4l2, tree or DeviceTree()
    _require_name(settings)
    identity = binding_of(devices.find(settings.device, settings.serial))
    model = _placeholder(settings.width, settings.height)

    def open_camera() -> LiveCamera:
        file = CameraFile(model, settings.rate_hz, None, identity)
        return open_bound(settings, file, "the recording", kernel, devices)

    return LiveSource(model, settings.rate_hz, identity, open_camera)


def _require_name(settings: V4l2Config) -> None:
    """A camera is never guessed."""
    if not settings.device and not settings.serial:
        raise ConfigError(
            "camera.v4l2.device: is empty: name the camera's socket (a name under "
            "/dev/v4l/by-path/), or its serial"
        )


def _placeholder(width: int, height: int) -> CameraModel:
    return CameraModel(width, height, width, width, (width - 1) / 2, (height - 1) / 2)


def _open_v4l2(
    config: CameraConfig, kernel: Kernel | None, tree: DeviceTree, *, colour: bool
) -> LiveSource:
    if not config.calibration:
        raise ConfigError(
            "camera.calibration: is empty: name the camera.toml of this camera; "
            "`mapvo calibrate` makes it"
        )
    settings, file = config.v4l2, load_camera_file(Path(config.calibration))
    _require_name(settings)

    def open_camera() -> LiveCamera:
        return open_bound(settings, file, config.calibration, kernel, tree, colour=colour)

    identity = file.identity or _identity_now(settings, tree)
    return LiveSource(file.camera, settings.rate_hz, identity, open_camera)


def _identity_now(settings: V4l2Config, tree: DeviceTree) -> str:
    """What is plugged in, for recordings by a calibration that names no camera."""
    try:
        return binding_of(tree.find(settings.device, settings.serial))
    except CameraLost:
        return ""


def _open_oak(config: CameraConfig, *, colour: bool) -> LiveSource:
    """With a calibration of our own it need not be there yet."""
    stopping = threading.Event()
    open_device = partial(OakCamera, colour=colour, go_on=lambda: not stopping.is_set())
    if config.calibration:
        file = load_camera_file(Path(config.calibration))
        _check_size(file.camera, config)
        opener = oak_opener(config.oak, file.identity, config.calibration, open_device=open_device)
        rate_hz, identity = config.oak.rate_hz, file.identity
        return LiveSource(file.camera, rate_hz, identity, opener, stopping=stopping)
    first = open_device(config.oak)
    try:
        camera = device_calibration(first.opened, config.oak)
    except BaseException:
        first.close()
        raise
    # Another device that is plugged in later has another lens.
    said_by = "the device's own calibration"
    opener = oak_opener(config.oak, first.identity, said_by, first, open_device)
    rate_hz, identity = config.oak.rate_hz, first.identity
    return LiveSource(camera, rate_hz, identity, opener, stopping=stopping)


def _check_size(camera: CameraModel, config: CameraConfig) -> None:
    if (camera.width, camera.height) != (config.oak.width, config.oak.height):
        raise ConfigError(
            f"{config.calibration}: is for {camera.width}x{camera.height}, camera.oak is set to "
            f"{config.oak.width}x{config.oak.height}: calibrate for this size or set that"
        )


def open_bound(
    settings: V4l2Config,
    file: CameraFile,
    calibration: str,
    kernel: Kernel | None,
    tree: DeviceTree,
    *,
    colour: bool = False,
) -> V4l2Camera:
    """The camera, if the calibration is its own; CameraRefused if it is another one's."""
    check_binding(
        file.identity, tree.find(settings.device, settings.serial), tree.all(), calibration
    )
    return V4l2Camera(settings, file.camera, kernel, tree, colour=colour)
