# SPDX-License-Identifier: Apache-2.0
"""A live camera that comes back after it was lost."""

import dataclasses
import logging
from collections.abc import Callable, Iterator
from typing import Protocol

from edge.errors import CameraLost
from edge.geometry.camera import CameraModel
from edge.types import Frame

log = logging.getLogger(__name__)

_RETRY_FIRST_S = 0.1
_RETRY_MOST_S = 1.0  # it is back within 3 s of its return, opening included


class LiveCamera(Protocol):
    """An open device: iterating gives frames until `stop`, or raises CameraLost."""

    @property
    def dropped(self) -> int:
        """Frames lost since it was opened."""
        ...

    def __iter__(self) -> Iterator[Frame]: ...

    def stop(self) -> None:
        """Let iterating end soon; any thread may call it."""
        ...

    def close(self) -> None:
        """Free the device."""
        ...


class ReopeningCamera:
    """Opens the same camera again and again, for as long as one asks for frames.

    `open_camera` gives an open device or raises CameraLost; it must find the camera by what
    it is, not by the number that it has today. CameraRefused passes through: a person has to
    act. Frames keep counting upwards over a loss.

    Owned by one thread; `stop` may be called from any. `sleep` takes seconds and may return
    early when stopped, `now_ns` is the monotonic clock.
    """

    def __init__(
        self,
        camera: CameraModel,
        rate_hz: float,
        open_camera: Callable[[], LiveCamera],
        *,
        sleep: Callable[[float], object],
        now_ns: Callable[[], int],
    ) -> None:
        self.camera = camera
        self.rate_hz = rate_hz
        self.losses = 0
        self._open_camera = open_camera
        self._sleep = sleep
        self._now_ns = now_ns
        self._device: LiveCamera | None = None
        self._dropped = 0
        self._next_index = 0
        self._stopped = False
        self._said = ""
        self._lost_ns: int | None = None

    @property
    def dropped(self) -> int:
        """Frames lost while a device was open, of all devices so far."""
        return self._dropped + (self._device.dropped if self._device else 0)

    def __iter__(self) -> Iterator[Frame]:
        retry_s = _RETRY_FIRST_S
        while not self._stopped:
            began = self._next_index
            try:
                self._device = self._open_camera()
                yield from self._play(self._device)
            except CameraLost as error:
                if self._next_index > began:  # it worked: what follows is a new loss
                    retry_s = _RETRY_FIRST_S
                if not self._stopped:
                    self._say_lost(error)
            finally:
                self._release()
            if not self._stopped:
                self._sleep(retry_s)
                retry_s = min(2.0 * retry_s, _RETRY_MOST_S)

    def stop(self) -> None:
        """Let iterating end soon."""
        self._stopped = True
        if (device := self._device) is not None:
            device.stop()

    def _play(self, device: LiveCamera) -> Iterator[Frame]:
        """Frames of one opening, numbered on from the last one's."""
        if self._stopped:  # while it was being opened
            return
        offset = 0
        for frame in device:
            self._say_back()
            # A device that was opened anew counts anew.
            index = max(frame.index + offset, self._next_index)
            offset, self._next_index = index - frame.index, index + 1
            yield dataclasses.replace(frame, index=index)

    def _release(self) -> None:
        device, self._device = self._device, None
        if device is not None:
            self._dropped += device.dropped
            device.close()

    def _say_lost(self, error: CameraLost) -> None:
        """One line for each new reason, not one for each attempt."""
        if self._lost_ns is None:
            self._lost_ns = self._now_ns()
            self.losses += 1
        if str(error) != self._said:
            self._said = str(error)
            log.warning("event=camera_lost %s", error)

    def _say_back(self) -> None:
        if self._lost_ns is not None:
            log.info("event=camera_back after_s=%.1f", (self._now_ns() - self._lost_ns) * 1e-9)
        self._lost_ns, self._said = None, ""
