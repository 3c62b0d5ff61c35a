# SPDX-License-Identifier: Apache-2.0
"""A live OAK camera, by a child process that may hang or die without harm."""

import logging
import math
import os
import select
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path

import cv2
import msgspec
import numpy as np

from edge.cameras.oak_calibration import camera_from_device
from edge.cameras.oak_link import (
    Gone,
    ImageSlots,
    Message,
    Opened,
    Order,
    Receiver,
    Refused,
    Replay,
    Taken,
    make_memory,
    rows_of,
)
from edge.config.oak import OakConfig
from edge.errors import CameraLost, CameraRefused
from edge.geometry.camera import CameraModel
from edge.types import U8, Frame

log = logging.getLogger(__name__)

_POLL_S = 0.1  # how soon `stop` is heard
_END_S = 2.0  # for closing a device in good order, before it is killed
_FRESH_IMAGES = 4  # of those that wait, so many are surely whole still
_BASE_ISO = 100.0  # gain 1
_COLOUR_SOCKET = "CAM_A"
CHILD = (sys.executable, "-m", "edge.cameras.oak_child")
_SLOW_USB = ("LOW", "FULL", "HIGH")


class OakCamera:
    """An open device; frames carry the middle of their exposure on the monotonic clock.

    Iterating gives frames until `stop`, or raises CameraLost when the device or its process is
    gone, or nothing comes for long. `dropped` counts what the device's numbers leave out and what
    we were too late for. Owned by one thread; `stop` may be called from any.
    """

    def __init__(
        self,
        config: OakConfig,
        replay: Replay | None = None,
        child: Sequence[str] = CHILD,
        *,
        colour: bool = False,
        go_on: Callable[[], bool] = lambda: True,
    ) -> None:
        """With `colour`, frames make it when asked; grey sensors have none.

        Opening may take many seconds: it is given up where `go_on` says so.
        """
        self._config = config
        self._go_on = go_on
        self._colour = colour and config.socket == _COLOUR_SOCKET
        self.dropped = 0
        self._stopped = False
        self._next_sequence: int | None = None
        self._last_t_ns = -1
        memory_fd = make_memory()
        read_fd, write_fd = os.pipe2(os.O_CLOEXEC)
        try:
            order = Order(config, memory_fd, write_fd, replay, self._colour)
            self._slots = ImageSlots(memory_fd, config.width, rows_of(order))
            self._process = subprocess.Popen(
                [*child, msgspec.json.encode(order).decode()],
                stdin=subprocess.DEVNULL,
                stdout=sys.stderr.fileno() if _has_descriptor(sys.stderr) else subprocess.DEVNULL,
                pass_fds=(memory_fd, write_fd),
                start_new_session=True,  # Ctrl-C is ours to hear
                env=_environment(),
            )
        except BaseException:
            os.close(read_fd)
            raise
        finally:
            os.close(write_fd)
            os.close(memory_fd)
        self._read_fd = read_fd
        self._receiver = Receiver(read_fd)
        self._waiting: list[Message] = []
        try:
            self.opened = self._wait_opened()
        except BaseException:
            self.close()
            raise
        self._report_opened()

    @property
    def identity(self) -> str:
        """What a calibration names the sensor by."""
        return identity_of(self.opened, self._config)

    def __iter__(self) -> Iterator[Frame]:
        self._pass_over_waiting()
        last_ns = time.monotonic_ns()
        while not self._stopped:
            message = self._next(_POLL_S)
            if message is None:
                if time.monotonic_ns() - last_ns > self._config.stall_s * 1e9:
                    raise CameraLost(f"OAK: gave no image for {self._config.stall_s:g} s")
                continue
            last_ns = time.monotonic_ns()
            if isinstance(message, Taken) and (frame := self._take(message)) is not None:
                yield frame

    def stop(self) -> None:
        """Let iterating end within 0.1 s."""
        self._stopped = True

    def close(self) -> None:
        """End the process and free its memory."""
        if self._read_fd < 0:
            return
        os.close(self._read_fd)  # it notices
        self._read_fd = -1
        self._process.terminate()
        try:
            self._process.wait(_END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._slots.close()

    def _wait_opened(self) -> Opened:
        ends_ns = time.monotonic_ns() + round(self._config.open_timeout_s * 1e9)
        while time.monotonic_ns() < ends_ns:
            if not self._go_on():
                raise CameraLost("OAK: was not waited for")
            message = self._next(_POLL_S)
            if isinstance(message, Opened):
                return message
        raise CameraLost(f"OAK: did not open within {self._config.open_timeout_s:g} s")

    def _next(self, timeout_s: float) -> Message | None:
        """The next message, or None in time; what tells of an end is raised."""
        if not self._waiting and select.select([self._read_fd], [], [], timeout_s)[0]:
            received = self._receiver.receive()
            self._waiting += received.messages
            if received.ended and not received.messages:
                raise CameraLost(f"OAK: its process ended (status {self._process.wait()})")
        if not self._waiting:
            return None
        message = self._waiting.pop(0)
        if isinstance(message, Refused):
            raise CameraRefused(f"OAK: {message.reason}")
        if isinstance(message, Gone):
            raise CameraLost(f"OAK: {message.reason}")
        return message

    def _pass_over_waiting(self) -> None:
        """Forget images that came before anybody asked for some: their slots are used again."""
        while select.select([self._read_fd], [], [], 0.0)[0]:
            received = self._receiver.receive()
            self._waiting += received.messages
            if received.ended:
                break
        images = [message for message in self._waiting if isinstance(message, Taken)]
        late = images[: -_FRESH_IMAGES or None]
        self._waiting = [message for message in self._waiting if message not in late]

    def _take(self, taken: Taken) -> Frame | None:
        image = self._slots.read(taken.slot, taken.mark)
        if self._next_sequence is not None:
            self.dropped += max(0, taken.sequence - self._next_sequence)
        self._next_sequence = taken.sequence + 1
        if image is None or taken.t_ns <= self._last_t_ns:
            self.dropped += 1
            return None
        self._last_t_ns = taken.t_ns
        gain_db = 20.0 * math.log10(taken.iso / _BASE_ISO) if taken.iso > 0 else None
        grey = image[: self._config.height]
        colour = partial(_from_nv12, image) if self._colour else None
        exposure_ns = taken.exposure_ns or None
        return Frame(taken.sequence, taken.t_ns, grey, exposure_ns, gain_db, colour)

    def _report_opened(self) -> None:
        opened = self.opened
        log.info(
            "event=camera_open device=%s product=%s usb=%s size=%dx%d",
            *(opened.device_id, opened.product, opened.usb_speed),
            *(self._config.width, self._config.height),
        )
        if opened.usb_speed in _SLOW_USB:
            log.warning(
                "event=camera_usb_slow device=%s usb=%s: use a USB 3 socket and cable",
                opened.device_id,
                opened.usb_speed,
            )


def _from_nv12(image: U8) -> U8:
    """Image (h, w, 3), red first."""
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_YUV2RGB_NV12), np.uint8)


def identity_of(opened: Opened, config: OakConfig) -> str:
    """What a calibration names the sensor by: each of a device has a lens of its own."""
    return f"oak:{opened.device_id} {config.socket}"


def device_calibration(opened: Opened, config: OakConfig) -> CameraModel:
    """The camera as the device describes it; CameraRefused where that must not be used."""
    if not opened.lens_model:
        raise CameraRefused(
            "OAK: the device says nothing about its lens: calibrate it (`mapvo calibrate`)"
        )
    if opened.is_default and not config.allow_default_calibration:
        raise CameraRefused(
            "OAK: the device has no calibration of its own, only its model's: calibrate it "
            "(`mapvo calibrate`), or set camera.oak.allow_default_calibration"
        )
    if opened.is_default:
        log.warning("event=default_calibration device=%s: some 1 %% off", opened.device_id)
    return camera_from_device(
        opened.lens_model, opened.K, opened.coefficients, config.width, config.height
    )


def oak_opener(
    config: OakConfig,
    bound: str,
    source: str,
    first: OakCamera | None = None,
    open_device: Callable[[OakConfig], OakCamera] = OakCamera,
) -> Callable[[], OakCamera]:
    """What opens the device again and again; `first` is one that is open already.

    CameraRefused where another device than that of the calibration `bound` is plugged in.
    """
    ready = [first] if first is not None else []

    def open_camera() -> OakCamera:
        camera = ready.pop() if ready else open_device(config)
        if bound and camera.identity != bound:
            camera.close()
            raise CameraRefused(
                f"{source}: is the calibration of {bound}, but the camera is {camera.identity}: "
                "plug that one in, or calibrate this one (`mapvo calibrate`)"
            )
        return camera

    return open_camera


def _environment() -> dict[str, str]:
    """As ours; depthai sends no statistics home and keeps its chatter low."""
    root = str(Path(__file__).resolve().parents[2])
    paths = [root, *filter(None, [os.environ.get("PYTHONPATH")])]
    return {
        "DEPTHAI_LEVEL": "error",
        **os.environ,
        "DEPTHAI_TELEMETRY": "0",
        "PYTHONPATH": os.pathsep.join(paths),
    }


def _has_descriptor(stream: object) -> bool:
    try:
        return stream is not None and stream.fileno() >= 0  # type: ignore[attr-defined]
    except (AttributeError, OSError, ValueError):
        return False
