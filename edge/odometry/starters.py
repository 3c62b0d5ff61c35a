# SPDX-License-Identifier: Apache-2.0
"""Which way of starting an image allows: by corners, or by edges where corners are few."""

from edge.config.odometry import OdometryConfig
from edge.lines.work import Clock, no_clock
from edge.odometry.line_start import LineStarter
from edge.odometry.starter import Start, Starter
from edge.types import U8, Frame, LineSearch, Pinhole


class Starters:
    """Owned by the tracking thread. Edges are looked for only while corners are too few."""

    def __init__(
        self, pinhole: Pinhole, mask: U8, config: OdometryConfig, clock: Clock = no_clock
    ) -> None:
        """`clock` tells what looking for edges costs."""
        self._by_corners = Starter(pinhole, mask, config)
        self._by_lines = LineStarter(pinhole, mask, config, clock) if config.start_lines else None

    def reset(self) -> None:
        """Forget the references."""
        self._by_corners.reset()
        if self._by_lines is not None:
            self._by_lines.reset()

    @property
    def has_reference(self) -> bool:
        """Whether a frame with enough to follow is held."""
        by_lines = self._by_lines is not None and self._by_lines.has_reference
        return self._by_corners.has_reference or by_lines

    def take_line_searches(self) -> tuple[LineSearch, ...]:
        """Searches for edges since the last call."""
        return () if self._by_lines is None else self._by_lines.work.take()

    def step(self, frame: Frame, grey: U8) -> Start | None:
        """Take the next undistorted image (h, w); the start, once it is certain enough."""
        start = self._by_corners.step(frame, grey)
        if self._by_lines is None:
            return start
        if self._by_corners.has_reference:
            self._by_lines.reset()
            return start
        return self._by_lines.step(frame, grey)
