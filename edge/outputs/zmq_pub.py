# SPDX-License-Identifier: Apache-2.0
"""Publishes poses, odometry, fixes, changes and status over ZeroMQ."""

import logging
import time
from collections import Counter
from collections.abc import Callable

import zmq

from edge import __version__
from edge.config.outputs import ZmqConfig
from edge.errors import OutputError
from edge.outputs import wire
from edge.outputs.binding import bind
from edge.outputs.change_message import change_message
from edge.outputs.curve import CurveServer
from edge.outputs.motion import MotionEstimator
from edge.outputs.report import FrameReport
from edge.outputs.status import Facts, StatusTally

log = logging.getLogger(__name__)

_NOTICES_A_CALL = 64  # more wait for the next frame
_WAITING_NOTICES = 16  # of one peer, in the socket
_MAX_RECEIVED_BYTES = 4096  # the handshake of CURVE has some hundreds


class ZmqPublisher:
    """An XPUB socket: sending never waits, a slow subscriber loses messages.

    Owned by the tracking thread, which calls `write` for each frame and `tick` where none comes.
    """

    def __init__(
        self,
        config: ZmqConfig,
        context: "zmq.Context[zmq.Socket[bytes]] | None" = None,
        curve: CurveServer | None = None,
    ) -> None:
        self._config = config
        self._seq: Counter[str] = Counter()
        self._motion = MotionEstimator()
        self.tally = StatusTally(time.monotonic_ns())
        self.status: wire.StatusMessage | None = None  # the last one that was sent
        self._own_context = None if context else zmq.Context()
        self.socket = (context or self._own_context or zmq.Context()).socket(zmq.XPUB)
        self.socket.sndhwm = config.queue_messages
        self.socket.linger = 200  # [ms] so that the last messages of a replay arrive
        self.socket.rcvhwm = _WAITING_NOTICES
        self.socket.maxmsgsize = _MAX_RECEIVED_BYTES
        self.socket.setsockopt(zmq.XPUB_WELCOME_MSG, wire.encode(_welcome(config), config.format))
        if curve is not None:
            curve.protect(self.socket)
        try:
            self.endpoint = bind(self.socket, config.endpoint, "outputs.zmq.endpoint")
        except OutputError:
            self.close()
            raise
        log.info("event=zmq_bound endpoint=%s", self.endpoint)

    def write(self, report: FrameReport, facts: Callable[[], Facts] = Facts) -> None:
        """Send what one frame gave; the pose first, as somebody steers by it."""
        now_ns = time.monotonic_ns()
        velocity = self._motion.step(report.update, report.pose)
        if report.pose is not None:
            seq = self._next("pose")
            self._send(wire.pose_message(report, report.pose, velocity, seq, now_ns))
        self._send(wire.odom_message(report, self._next("odom"), now_ns))
        for fix in report.fixes:
            self._send(wire.fix_message(fix, self._next("fix"), now_ns))
        for event in report.changes:
            self._send(change_message(event, self._next("change"), now_ns))
        self.tally.add(report, now_ns)
        self.tick(facts)

    def tick(self, facts: Callable[[], Facts] = Facts) -> None:
        """Send the status where it is due, and take in new subscriptions."""
        self._drop_notices()
        now_ns = time.monotonic_ns()
        if now_ns - self.tally.since_ns >= self._config.status_interval_s * 1e9:
            self.send_status(facts())

    def send_status(self, facts: Facts) -> None:
        """Send the status now."""
        self.status = self.tally.message(self._next("status"), time.monotonic_ns(), facts)
        self._send(self.status)

    def close(self) -> None:
        """Send what waits for at most 0.2 s, then free the port."""
        self.socket.close()
        if self._own_context is not None:
            self._own_context.term()

    def _next(self, topic: str) -> int:
        self._seq[topic] += 1
        return self._seq[topic] - 1

    def _send(self, message: wire.Message) -> None:
        self.socket.send(wire.encode(message, self._config.format), zmq.DONTWAIT)

    def _drop_notices(self) -> None:
        """Throw away what subscribers sent, which the socket has heeded: else it would pile up."""
        for _ in range(_NOTICES_A_CALL):
            try:
                self.socket.recv(zmq.DONTWAIT)
            except zmq.Again:
                return


def _welcome(config: ZmqConfig) -> wire.WelcomeMessage:
    topics = tuple(name for name in wire.TOPICS if name != "welcome")
    return wire.WelcomeMessage(wire.SCHEMA_VERSION, __version__, config.format, topics)
