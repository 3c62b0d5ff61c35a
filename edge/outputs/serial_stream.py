# SPDX-License-Identifier: Apache-2.0
"""What goes over a serial line and when: poses up to a rate, a status once a second."""

from typing import NamedTuple, Protocol

import numpy as np

from edge.outputs.frames import BodyFrames, BodyPose
from edge.outputs.motion import MotionEstimator
from edge.outputs.report import FrameReport
from edge.types import OdometryState

_STATUS_INTERVAL_NS = 1_000_000_000
_SILENT_NS = 1_000_000_000  # without a frame for so long, the last one's word is no longer good


class LinkStatus(NamedTuple):
    """How it goes, once a second."""

    now_ns: int
    localised: bool
    state: OdometryState
    frames: int
    published: int


class SerialProtocol(Protocol):
    """Turns what is to be said into bytes."""

    def pose(self, body: BodyPose, quality: float, age_ns: int) -> bytes:
        """One pose; `age_ns` since its capture."""
        ...

    def status(self, status: LinkStatus) -> bytes:
        """The status of this second."""
        ...

    def notice(self, text: str) -> bytes:
        """One line for a person; empty where the protocol has no words."""
        ...


class SerialStream:
    """Chooses what to send after each frame, and at least once a second.

    Owned by one thread.
    """

    def __init__(self, protocol: SerialProtocol, frames: BodyFrames, rate_hz: float) -> None:
        self._protocol = protocol
        self._frames = frames
        self._poses = _Pacer(round(1e9 / rate_hz))
        self._statuses = _Pacer(_STATUS_INTERVAL_NS)
        self._motion = MotionEstimator()
        self._last: FrameReport | None = None
        self._last_ns = 0
        self._counts = np.zeros(2, np.int64)

    def step(self, report: FrameReport | None, now_ns: int) -> bytes:
        """Whole messages to send now, often none; without a report, only time has passed.

        A frame without a map pose gives no pose: silence means that it does not know.
        """
        message = b""
        if report is not None:
            self._last, self._last_ns = report, now_ns
            self._counts += 1, report.pose is not None
            message = self._pose(report, now_ns)
        if self._statuses.is_due(now_ns):
            message += self._protocol.status(self._status(now_ns))
        return message

    def tell(self, text: str) -> bytes:
        """Whole messages that carry one line for a person."""
        return self._protocol.notice(text)

    def _pose(self, report: FrameReport, now_ns: int) -> bytes:
        velocity = self._motion.step(report.update, report.pose)
        if report.pose is None or not self._poses.is_due(now_ns):
            return b""
        body = self._frames.convert(report.pose, velocity)
        age_ns = round(report.timing.latency * 1e6)
        return self._protocol.pose(body, report.update.quality, age_ns)

    def _status(self, now_ns: int) -> LinkStatus:
        frames, published = map(int, self._counts)
        if self._last is None or now_ns - self._last_ns > _SILENT_NS:
            return LinkStatus(now_ns, False, OdometryState.WAITING, frames, published)
        localised = self._last.pose is not None
        return LinkStatus(now_ns, localised, self._last.update.state, frames, published)


class _Pacer:
    """Says when the next one is due, so that on average no more than one an interval is."""

    def __init__(self, interval_ns: int) -> None:
        self._interval_ns = interval_ns
        self._next_ns: int | None = None

    def is_due(self, now_ns: int) -> bool:
        """Whether to send now; then it counts as sent."""
        # Frames that come a little early pass, else jitter would lose every second one.
        if self._next_ns is not None and now_ns < self._next_ns - self._interval_ns // 4:
            return False
        late = self._next_ns is None or now_ns > self._next_ns + self._interval_ns
        self._next_ns = (now_ns if late else self._next_ns or 0) + self._interval_ns
        return True
