# SPDX-License-Identifier: Apache-2.0
"""Publishes poses, odometry, fixes and status over ZeroMQ."""

import logging
import time
from collections import Counter

import zmq

from edge import __version__
from edge.config.outputs import ZmqConfig
from edge.errors import OutputError
from edge.outputs import wire
from edge.outputs.report import FrameReport

log = logging.getLogger(__name__)


class ZmqPublisher:
    """A PUB socket: sending never waits, a slow subscriber loses messages.

    Owned by the tracking thread.
    """

    def __init__(self, config: ZmqConfig) -> None:
        self._config = config
        self._seq: Counter[str] = Counter()
        self._status = _StatusTally(time.monotonic_ns())
        self._context = zmq.Context()
        self._socket = self._context.socket(zmq.PUB)
        self._socket.sndhwm = config.queue_messages
        self._socket.linger = 200  # [ms] so that the last messages of a replay arrive
        try:
            self._socket.bind(config.endpoint)
        except zmq.ZMQError as error:
            self.close()
            raise OutputError(
                f"outputs.zmq.endpoint {config.endpoint}: {error.strerror}: "
                "end the other program there or name another endpoint"
            ) from error
        self.endpoint = self._socket.get_string(zmq.LAST_ENDPOINT)
        log.info("event=zmq_bound endpoint=%s", self.endpoint)

    def write(self, report: FrameReport) -> None:
        """Send what one frame gave; the pose first, as somebody steers by it."""
        now_ns = time.monotonic_ns()
        if report.pose is not None:
            self._send(wire.pose_message(report, report.pose, self._next("pose"), now_ns))
        self._send(wire.odom_message(report, self._next("odom"), now_ns))
        for fix in report.fixes:
            self._send(wire.fix_message(fix, self._next("fix"), now_ns))
        self._status.add(report)
        if now_ns - self._status.since_ns >= self._config.status_interval_s * 1e9:
            self._send(self._status.message(self._next("status"), now_ns))

    def close(self) -> None:
        """Send what waits for at most 0.2 s, then free the port."""
        self._socket.close()
        self._context.term()

    def _next(self, topic: str) -> int:
        self._seq[topic] += 1
        return self._seq[topic] - 1

    def _send(self, message: wire.Message) -> None:
        self._socket.send(wire.encode(message), zmq.DONTWAIT)


class _StatusTally:
    """Counts since the start, and the worst since the last status."""

    def __init__(self, now_ns: int) -> None:
        self.since_ns = now_ns
        self._frames = self._published = self._tried = self._accepted = 0
        self._frames_then = 0
        self._latency_ms = 0.0
        self._last: FrameReport | None = None

    def add(self, report: FrameReport) -> None:
        self._frames += 1
        self._published += report.pose is not None
        self._tried += len(report.fixes)
        self._accepted += sum(fix.accepted for fix in report.fixes)
        self._latency_ms = max(self._latency_ms, report.timing.latency)
        self._last = report

    def message(self, seq: int, now_ns: int) -> wire.StatusMessage:
        """The status now; begins the next interval."""
        assert self._last is not None
        seconds = (now_ns - self.since_ns) * 1e-9
        message = wire.StatusMessage(
            schema=wire.SCHEMA_VERSION,
            seq=seq,
            sent_ns=now_ns,
            t_ns=self._last.update.t_ns,
            version=__version__,
            state=self._last.update.state.value,
            localised=self._last.pose is not None,
            frames=self._frames,
            published=self._published,
            fixes_tried=self._tried,
            fixes_accepted=self._accepted,
            dropped_frames=self._last.dropped_frames,
            rate_hz=round((self._frames - self._frames_then) / seconds, 2),
            latency_ms=round(self._latency_ms, 3),
        )
        self.since_ns, self._frames_then, self._latency_ms = now_ns, self._frames, 0.0
        return message
