# SPDX-License-Identifier: Apache-2.0
"""A live camera of the kernel's video interface."""

import logging
from collections.abc import Iterator

from edge.cameras import v4l2_abi as abi
from edge.cameras.v4l2_controls import Taken, follow_automatic, set_exposure_and_gain
from edge.cameras.v4l2_identity import DeviceTree
from edge.cameras.v4l2_images import colour_reader, mid_exposure_ns, read_grey
from edge.cameras.v4l2_kernel import Kernel, LinuxKernel
from edge.cameras.v4l2_stream import Filled, VideoStream
from edge.config.v4l2 import V4l2Config
from edge.errors import CameraLost, CameraRefused
from edge.geometry.camera import CameraModel
from edge.types import Frame

log = logging.getLogger(__name__)

_POLL_S = 0.1  # how soon `stop` is heard
_MAX_ERRORS = 10  # in a row: more are no bad luck
_MAX_STAMP_ERROR_NS = 2_000_000_000  # further from now, a stamp is of another clock
_RATE_TOLERANCE = 0.02
_SEQUENCE_MASK = 0xFFFFFFFF
# Asking takes a USB camera a millisecond or two; automatic exposure moves slower than this.
_FOLLOW_FRAMES = 10


class V4l2Camera:
    """Frames with the middle of their exposure on the monotonic clock.

    It is open from the start until `close`. Iterating gives frames until `stop`, or raises
    CameraLost when the device is gone, stalls or fails. `dropped` counts what the driver lost
    (gaps in its sequence) and what came damaged. Images are copies: they may be kept.

    Owned by one thread; `stop` may be called from any.
    """

    def __init__(
        self,
        config: V4l2Config,
        camera: CameraModel,
        kernel: Kernel | None = None,
        tree: DeviceTree | None = None,
        *,
        colour: bool = False,
    ) -> None:
        """With `colour`, formats that have it come first, and frames make it when asked."""
        if (camera.width, camera.height) != (config.width, config.height):
            raise CameraRefused(
                f"the calibration is for {camera.width}x{camera.height}, the camera is set to "
                f"{config.width}x{config.height}: calibrate for this size or set that"
            )
        self._config = config
        self.camera = camera
        self._kernel = kernel or LinuxKernel()
        self.identity = (tree or DeviceTree()).find(config.device, config.serial)
        self.dropped = 0
        self._stopped = False
        self._colour = colour
        self._next_sequence: int | None = None
        self._last_t_ns: int | None = None
        self._stream = VideoStream(self._kernel, self.identity.node)
        try:
            formats = config.formats
            if colour:
                formats = tuple(sorted(formats, key=lambda name: name == "GREY"))
            self._form = self._stream.choose_format(formats, config.width, config.height)
            self._rate_hz = self._stream.set_rate(config.rate_hz)
            self._fixed = Taken(set_exposure_and_gain(self._stream, config), _fixed_gain_db(config))
            self._follow = follow_automatic(self._stream, config)
            self._taken = self._fixed
            self._stream.start(config.buffers)
        except BaseException:
            self._stream.close()
            raise
        self._report_opened()

    @property
    def rate_hz(self) -> float:
        """Frame rate that the device has agreed to."""
        return self._rate_hz

    def __iter__(self) -> Iterator[Frame]:
        errors = 0
        last_ns = self._kernel.monotonic_ns()
        while not self._stopped:
            try:
                filled = self._stream.next_filled(_POLL_S)
            except OSError as error:  # one image lost, says the kernel's documentation
                errors = self._count_error(errors, error)
                continue
            now_ns = self._kernel.monotonic_ns()
            if filled is None:
                if now_ns - last_ns > self._config.stall_s * 1e9:
                    raise CameraLost(
                        f"{self.identity.node}: gave no image for {self._config.stall_s:g} s"
                    )
                continue
            last_ns, errors = now_ns, 0
            if (frame := self._take(filled, now_ns)) is not None:
                yield frame

    def stop(self) -> None:
        """Let iterating end within 0.1 s."""
        self._stopped = True

    def close(self) -> None:
        """Free the device."""
        self._stream.close()

    def _take(self, filled: Filled, now_ns: int) -> Frame | None:
        """The frame in a buffer, which then belongs to the driver again."""
        try:
            self._check_clock(filled, now_ns)
            self._count_gap(filled.sequence)
            image, colour = None, None
            if not filled.flags & abi.BUF_FLAG_ERROR:
                memory = self._stream.memory(filled.buffer)
                image = read_grey(memory, filled.used_bytes, self._form)
                if self._colour:
                    colour = colour_reader(memory, filled.used_bytes, self._form)
        finally:
            self._stream.give_back(filled.buffer)
        if filled.sequence % _FOLLOW_FRAMES == 0 or self._last_t_ns is None:
            self._ask_how_taken()
        t_ns = mid_exposure_ns(filled, self._taken.exposure_ns or 0, self._config)
        if image is None or (self._last_t_ns is not None and t_ns <= self._last_t_ns):
            self.dropped += 1
            return None
        self._last_t_ns = t_ns
        taken = self._taken
        return Frame(filled.sequence, t_ns, image, taken.exposure_ns, taken.gain_db, colour)

    def _ask_how_taken(self) -> None:
        """What is fixed stays; what the camera decides itself is asked for."""
        now = self._follow()
        self._taken = Taken(
            self._fixed.exposure_ns if now.exposure_ns is None else now.exposure_ns,
            self._fixed.gain_db if now.gain_db is None else now.gain_db,
        )

    def _check_clock(self, filled: Filled, now_ns: int) -> None:
        """Poses would be of another moment than they say."""
        kind = filled.flags & abi.BUF_FLAG_TIMESTAMP_MASK
        if kind != abi.BUF_FLAG_TIMESTAMP_MONOTONIC:
            raise CameraRefused(
                f"{self.identity.node}: does not stamp by the monotonic clock: "
                "for USB cameras, set the uvcvideo module's clock=CLOCK_MONOTONIC"
            )
        if filled.flags & abi.BUF_FLAG_ERROR:  # its stamp may be anything
            return
        if abs(now_ns - filled.stamp_ns) > _MAX_STAMP_ERROR_NS:
            off_s = (filled.stamp_ns - now_ns) * 1e-9
            raise CameraRefused(
                f"{self.identity.node}: its stamps are {off_s:+.1f} s off the monotonic clock: "
                "for USB cameras, set the uvcvideo module's clock=CLOCK_MONOTONIC"
            )

    def _count_gap(self, sequence: int) -> None:
        if self._next_sequence is not None:
            gap = (sequence - self._next_sequence) & _SEQUENCE_MASK
            # A driver that counts backwards has begun anew: nobody knows what was lost.
            self.dropped += gap if gap < _SEQUENCE_MASK // 2 else 0
        self._next_sequence = (sequence + 1) & _SEQUENCE_MASK

    def _count_error(self, errors: int, error: OSError) -> int:
        # The image itself is missing in the sequence and counted there.
        if errors + 1 >= _MAX_ERRORS:
            raise CameraLost(
                f"{self.identity.node}: {_MAX_ERRORS} images in a row failed: check its cable"
            ) from error
        return errors + 1

    def _report_opened(self) -> None:
        log.info(
            "event=camera_open device=%s name=%r id=%s format=%s size=%dx%d rate_hz=%.3g",
            self.identity.node,
            self._stream.card,
            self.identity.key,
            self._form.name,
            self._form.width,
            self._form.height,
            self._rate_hz,
        )
        if abs(self._rate_hz / self._config.rate_hz - 1.0) > _RATE_TOLERANCE:
            log.warning(
                "event=camera_rate device=%s rate_hz=%.3g wanted=%.3g: set a rate that it has",
                self.identity.node,
                self._rate_hz,
                self._config.rate_hz,
            )


def _fixed_gain_db(config: V4l2Config) -> float | None:
    if config.gain is None or config.gain_db_per_step is None:
        return None
    return config.gain * config.gain_db_per_step
