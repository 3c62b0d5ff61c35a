# SPDX-License-Identifier: Apache-2.0
"""How it goes, counted for the status message and for Prometheus."""

import time
from typing import NamedTuple

from edge import __version__
from edge.outputs import wire
from edge.outputs.report import FrameReport, line_searches

_SILENT_NS = 1_000_000_000  # without a frame for so long, the last one's word is no longer good
LATENCY_BOUNDS_MS = (5.0, 10.0, 20.0, 33.0, 50.0, 100.0, 200.0, 500.0)


class Facts(NamedTuple):
    """What only the daemon knows; a replay has none of it."""

    map: str = ""
    camera: str = "ok"
    camera_losses: int = 0
    level: int = 0
    given_up: tuple[str, ...] = ()
    reasons: tuple[str, ...] = ()
    temperature_c: float | None = None
    refused_clients: int = 0
    recorder: str = ""
    notice: str = ""
    segmenter: str = ""


class StatusTally:
    """Counts since the start, and the worst since the last status.

    Owned by the tracking thread; others may read the public counts.
    """

    def __init__(self, now_ns: int) -> None:
        self.since_ns = self._began_ns = now_ns
        self.frames = self.tracked = self.published = 0
        self.fixes_tried = self.fixes_accepted = self.dropped = 0
        self.latency_counts = [0] * (len(LATENCY_BOUNDS_MS) + 1)
        self.latency_sum_ms = 0.0
        self.line_searches = self.line_segments = 0
        self.line_ms = 0.0
        self._frames_then = 0
        self._cpu_then_s = time.process_time()
        self._latency_ms = 0.0
        self._last: FrameReport | None = None
        self._last_ns = 0

    def add(self, report: FrameReport, now_ns: int) -> None:
        """Count one frame."""
        self.frames += 1
        self.tracked += report.update.T_odom_cam is not None
        self.published += report.pose is not None
        self.fixes_tried += len(report.fixes)
        self.fixes_accepted += sum(fix.accepted for fix in report.fixes)
        self.dropped = report.dropped_frames
        latency_ms = report.timing.latency
        self._latency_ms = max(self._latency_ms, latency_ms)
        self.latency_sum_ms += latency_ms
        self.latency_counts[sum(latency_ms > bound for bound in LATENCY_BOUNDS_MS)] += 1
        for search in line_searches(report):
            self.line_searches += 1
            self.line_segments += search.segments
            self.line_ms += search.ms
        self._last, self._last_ns = report, now_ns

    def message(self, seq: int, now_ns: int, facts: Facts) -> wire.StatusMessage:
        """The status now; begins the next interval."""
        seconds = max((now_ns - self.since_ns) * 1e-9, 1e-9)
        cpu_s = time.process_time()
        last = self._last
        fresh = last is not None and now_ns - self._last_ns < _SILENT_NS
        message = wire.StatusMessage(
            schema=wire.SCHEMA_VERSION,
            seq=seq,
            sent_ns=now_ns,
            t_ns=0 if last is None else last.update.t_ns,
            version=__version__,
            uptime_s=round((now_ns - self._began_ns) * 1e-9, 3),
            map=facts.map,
            camera=facts.camera,
            camera_losses=facts.camera_losses,
            state=last.update.state.value if last is not None and fresh else "waiting",
            localised=last is not None and fresh and last.pose is not None,
            frames=self.frames,
            published=self.published,
            fixes_tried=self.fixes_tried,
            fixes_accepted=self.fixes_accepted,
            dropped_frames=self.dropped,
            rate_hz=round((self.frames - self._frames_then) / seconds, 2),
            latency_ms=round(self._latency_ms, 3),
            level=facts.level,
            given_up=facts.given_up,
            reasons=facts.reasons,
            temperature_c=facts.temperature_c,
            cpu_cores=round((cpu_s - self._cpu_then_s) / seconds, 3),
            refused_clients=facts.refused_clients,
            recorder=facts.recorder,
            segmenter=facts.segmenter,
            notice=facts.notice,
        )
        self.since_ns, self._frames_then, self._latency_ms = now_ns, self.frames, 0.0
        self._cpu_then_s = cpu_s
        return message
