# SPDX-License-Identifier: Apache-2.0
"""What the runtime asks of anything that gives frames."""

from collections.abc import Iterator
from typing import Protocol

from edge.geometry.camera import CameraModel
from edge.types import Frame


class Camera(Protocol):
    """A source of grey frames, live or recorded.

    Iterating gives each frame once and ends when the source ends. A frame that cannot be had is
    left out and counted, never replaced; a live source that stops for good raises CameraLost.
    """

    @property
    def camera(self) -> CameraModel:
        """Calibration of the images that come."""
        ...

    @property
    def rate_hz(self) -> float:
        """Nominal frame rate."""
        ...

    @property
    def dropped(self) -> int:
        """How many frames were left out so far."""
        ...

    def __iter__(self) -> Iterator[Frame]: ...
