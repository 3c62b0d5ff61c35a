# SPDX-License-Identifier: Apache-2.0
"""A recording played as if it were a live camera: at its own rate, stamped as it comes."""

import threading
import time
from collections.abc import Iterator
from functools import partial
from itertools import chain, repeat
from typing import Literal

from edge.cameras.recording import Recording
from edge.errors import CameraLost
from edge.geometry.camera import CameraModel
from edge.types import Frame

_MOST_GAP = 10.0  # intervals; longer pauses of a recording are not waited for


class PacedRecording:
    """Frames with the monotonic time at which they come, counted on from one round to the next.

    `play` says what follows the last frame: nothing, the first one (a jump), or the way back.
    Owned by one thread; `stop` may be called from any.
    """

    losses = 0

    def __init__(
        self, recording: Recording, play: Literal["once", "again", "forth_and_back"]
    ) -> None:
        self._recording = recording
        self._play = play
        self._stopped = threading.Event()

    @property
    def camera(self) -> CameraModel:
        """Calibration of the images."""
        return self._recording.camera

    @property
    def rate_hz(self) -> float:
        """Nominal frame rate."""
        return self._recording.rate_hz

    @property
    def dropped(self) -> int:
        """Images that could not be read."""
        return self._recording.dropped

    def __iter__(self) -> Iterator[Frame]:
        interval_ns = round(1e9 / self.rate_hz)
        due_ns, last_t_ns = time.monotonic_ns(), None
        played = 0
        for index in self._order():
            if self._stopped.is_set():
                return
            if (image := self._recording.image(index)) is None:
                continue
            t_ns = int(self._recording.t_ns[index])
            if last_t_ns is not None:
                step_ns = abs(t_ns - last_t_ns)
                due_ns += step_ns if 0 < step_ns < _MOST_GAP * interval_ns else interval_ns
            last_t_ns = t_ns
            late_ns = time.monotonic_ns() - due_ns
            if late_ns > interval_ns:  # reading is too slow: a camera would not wait either
                due_ns += late_ns
            elif self._stopped.wait(max(-late_ns, 0) * 1e-9):
                return
            yield Frame(played, due_ns, image, colour=partial(self._recording.colour, index))
            played += 1
        if played == 0:
            raise CameraLost(f"{self._recording.root}: holds no image that can be read")

    def stop(self) -> None:
        """Let iterating end at once."""
        self._stopped.set()

    def close(self) -> None:
        """Nothing to free."""

    def _order(self) -> Iterator[int]:
        """Indices of the frames, for ever unless played once."""
        forth = [int(index) for index in self._recording.indices]
        rounds = repeat(forth) if self._play == "again" else repeat(forth, 1)
        if self._play == "forth_and_back" and len(forth) > 1:
            back = forth[-2:0:-1]
            rounds = repeat(forth + back)
        return chain.from_iterable(rounds)
