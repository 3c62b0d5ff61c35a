# SPDX-License-Identifier: Apache-2.0
"""Figures for Prometheus: the text, and as little HTTP as carries it."""

import logging
import socket
from collections.abc import Callable
from typing import NamedTuple

from edge.config.outputs import MetricsConfig
from edge.errors import OutputError
from edge.outputs.status import LATENCY_BOUNDS_MS, StatusTally
from edge.outputs.wire import StatusMessage

log = logging.getLogger(__name__)

_MAX_CONNECTIONS = 8
_MAX_REQUEST_BYTES = 4096
_TYPE = "text/plain; version=0.0.4; charset=utf-8"


class Figure(NamedTuple):
    """One metric: its name, its kind, and what it says."""

    name: str
    kind: str
    help: str
    value: float


def render(tally: StatusTally, status: StatusMessage | None) -> str:
    """The exposition text: counts as they are now, the rest as of the last status."""
    figures = [
        Figure("frames_total", "counter", "Frames taken", tally.frames),
        Figure("frames_tracked_total", "counter", "Frames with odometry", tally.tracked),
        Figure("frames_published_total", "counter", "Frames with a map pose", tally.published),
        Figure("frames_dropped_total", "counter", "Frames overtaken or unreadable", tally.dropped),
        Figure("fixes_tried_total", "counter", "Searches in the map", tally.fixes_tried),
        Figure("fixes_accepted_total", "counter", "Searches that counted", tally.fixes_accepted),
        Figure("line_searches_total", "counter", "Images searched for lines", tally.line_searches),
        Figure("lines_seen_total", "counter", "Lines in those images", tally.line_segments),
        Figure("line_seconds_total", "counter", "Spent on that", tally.line_ms / 1000.0),
    ]
    if status is not None:
        figures += [
            Figure("localised", "gauge", "1 with a map pose", float(status.localised)),
            Figure("camera_ok", "gauge", "1 while frames come", float(status.camera == "ok")),
            Figure("camera_losses_total", "counter", "Times it was lost", status.camera_losses),
            Figure("rate_hz", "gauge", "Frames a second", status.rate_hz),
            Figure("ladder_level", "gauge", "0 gives up nothing", status.level),
            Figure("cpu_cores", "gauge", "Cores kept busy", status.cpu_cores),
            Figure("clients_refused_total", "counter", "Refused clients", status.refused_clients),
            Figure("uptime_seconds", "gauge", "Since the start", status.uptime_s),
        ]
        if status.temperature_c is not None:
            figures.append(
                Figure("temperature_celsius", "gauge", "Hottest sensor", status.temperature_c)
            )
    lines = []
    for name, kind, text, value in figures:
        lines += [f"# HELP mapvo_{name} {text}", f"# TYPE mapvo_{name} {kind}"]
        lines.append(f"mapvo_{name} {value:g}" if value % 1 else f"mapvo_{name} {int(value)}")
    return "\n".join(lines + _latency(tally)) + "\n"


def _latency(tally: StatusTally) -> list[str]:
    name = "mapvo_latency_seconds"
    lines = [f"# HELP {name} From capture to publication", f"# TYPE {name} histogram"]
    total = 0
    for bound_ms, count in zip(LATENCY_BOUNDS_MS, tally.latency_counts, strict=False):
        total += count
        lines.append(f'{name}_bucket{{le="{bound_ms / 1000:g}"}} {total}')
    total += tally.latency_counts[-1]
    lines.append(f'{name}_bucket{{le="+Inf"}} {total}')
    return [*lines, f"{name}_sum {tally.latency_sum_ms / 1000:.6f}", f"{name}_count {total}"]


class MetricsServer:
    """Answers every request with the text and hangs up; a slow client holds nobody up.

    Owned by one thread, which calls `accept` or `answer` when a socket is readable.
    """

    def __init__(self, config: MetricsConfig, text: Callable[[], str]) -> None:
        self._text = text
        self._connections: dict[int, socket.socket] = {}
        try:
            self.listener = socket.create_server((config.address, config.port))
        except OSError as error:
            raise OutputError(
                f"outputs.metrics.port {config.port}: {error.strerror or error}: "
                "end the other program there, name another port, or 0 for none"
            ) from error
        self.listener.setblocking(False)
        self.port: int = self.listener.getsockname()[1]

    @property
    def connections(self) -> list[int]:
        """File descriptors of clients that have not asked yet."""
        return list(self._connections)

    def accept(self) -> None:
        """Take one new client in; with too many, the one that has waited longest goes."""
        try:
            connection, _ = self.listener.accept()
        except OSError:
            return
        connection.setblocking(False)
        if len(self._connections) >= _MAX_CONNECTIONS:
            self._hang_up(next(iter(self._connections)))
        self._connections[connection.fileno()] = connection

    def answer(self, descriptor: int) -> None:
        """Answer the client that has asked."""
        connection = self._connections[descriptor]
        try:
            asked = connection.recv(_MAX_REQUEST_BYTES)
            if asked.startswith((b"GET / ", b"GET /metrics ")):
                body, status = self._text().encode(), "200 OK"
            else:
                body, status = b"see /metrics\n", "404 Not Found"
            head = (
                f"HTTP/1.1 {status}\r\nContent-Type: {_TYPE}\r\n"
                f"Content-Length: {len(body)}\r\nConnection: close\r\n\r\n"
            )
            if asked:
                connection.send(head.encode() + body)  # some 3 kB: a socket's buffer takes it
                connection.shutdown(socket.SHUT_WR)
        except OSError as error:
            log.debug("event=metrics_client_gone %s", error)
        self._hang_up(descriptor)

    def close(self) -> None:
        """Hang up on all and free the port."""
        for descriptor in self.connections:
            self._hang_up(descriptor)
        self.listener.close()

    def _hang_up(self, descriptor: int) -> None:
        self._connections.pop(descriptor).close()
