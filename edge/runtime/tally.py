# SPDX-License-Identifier: Apache-2.0
"""Counts and times of a run, for stats.json."""

import os
import resource
import time
from pathlib import Path
from typing import Any

from edge.outputs.report import FrameReport
from edge.runtime.durations import Durations
from edge.types import LineSearch, OdometryState

_TIMED = ("decode", "track", "keyframe", "frame", "latency", "relocalise")


class LineTally:
    """Counts the images that were searched for lines to one end."""

    def __init__(self) -> None:
        self._images = self._segments = 0
        self._ms = Durations()

    def add(self, searches: tuple[LineSearch, ...]) -> None:
        """Count searches."""
        for search in searches:
            self._images += 1
            self._segments += search.segments
            self._ms.add(search.ms)

    def summary(self) -> dict[str, Any]:
        """What stats.json says of them."""
        return {
            "images": self._images,
            "segments_per_image": round(self._segments / max(self._images, 1), 1),
            "ms": self._ms.summary(),
        }


class Tally:
    """Made when the first frame is about to be asked for; counts from then on."""

    def __init__(self) -> None:
        self._start_s = _process_age_s()
        self._cpu_began_s, self._wall_began_s = _cpu_s(), time.monotonic()
        self._cpu_s = self._wall_s = 0.0
        self._ms = {name: Durations() for name in _TIMED}
        self._frames = self._tracked = self._published = self._keyframes = 0
        self._fixes_tried = self._fixes_accepted = self._dropped = 0
        self._fixes_by_lines = self._lines = 0
        self._first_pose_frame: int | None = None
        self._line_work = {name: LineTally() for name in ("start", "window", "fix")}

    def add(self, report: FrameReport, decode_ms: float) -> None:
        """Count one frame."""
        update, timing = report.update, report.timing
        self._frames += 1
        self._tracked += update.state is OdometryState.TRACKING
        self._keyframes += update.is_keyframe
        self._dropped = report.dropped_frames
        if report.pose is not None:
            self._published += 1
            if self._first_pose_frame is None:
                self._first_pose_frame = update.index
        self._ms["decode"].add(decode_ms)
        self._ms["track"].add(timing.track)
        self._ms["frame"].add(timing.frame)
        self._ms["latency"].add(timing.latency)
        if timing.keyframe > 0.0:
            self._ms["keyframe"].add(timing.keyframe)
        self._line_work["start"].add(update.line_searches)
        if update.keyframe is not None:
            self._line_work["window"].add(update.keyframe.line_searches)
        for fix in report.fixes:
            self._fixes_tried += 1
            self._fixes_accepted += fix.accepted
            self._fixes_by_lines += fix.fix.lines > 0
            self._lines += fix.fix.lines
            self._ms["relocalise"].add(fix.fix.ms)
            self._line_work["fix"].add(fix.fix.line_searches)

    def end(self) -> None:
        """Stop the clocks: the last frame is done."""
        self._cpu_s = _cpu_s() - self._cpu_began_s
        self._wall_s = time.monotonic() - self._wall_began_s

    def stats(self, map_bytes: int) -> dict[str, Any]:
        """The content of stats.json."""
        return {
            "frames": self._frames,
            "tracked": self._tracked,
            "published": self._published,
            "keyframes": self._keyframes,
            "fixes_tried": self._fixes_tried,
            "fixes_accepted": self._fixes_accepted,
            "fixes_by_lines": self._fixes_by_lines,
            "lines_per_fix": round(self._lines / max(self._fixes_by_lines, 1), 1),
            "line_work": {name: work.summary() for name, work in self._line_work.items()},
            "first_pose_frame": self._first_pose_frame,
            "dropped_frames": self._dropped,
            "cpu_s": round(self._cpu_s, 4),
            "wall_s": round(self._wall_s, 4),
            "start_s": round(self._start_s, 3),
            "peak_rss_mb": round(_peak_rss_mb(), 1),
            "map_bytes": map_bytes,
            "ms": {name: durations.summary() for name, durations in self._ms.items()},
        }


def _cpu_s() -> float:
    """CPU time of all threads and of children that have ended."""
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() + children.ru_utime + children.ru_stime


def _process_age_s() -> float:
    """Seconds since this process began."""
    stat = Path("/proc/self/stat").read_text(encoding="ascii")
    began_ticks = int(stat.rpartition(")")[2].split()[19])
    return time.clock_gettime(time.CLOCK_BOOTTIME) - began_ticks / os.sysconf("SC_CLK_TCK")


def _peak_rss_mb() -> float:
    """Largest resident memory of this process; getrusage would count what forked it, too."""
    for line in Path("/proc/self/status").read_text(encoding="ascii").splitlines():
        if line.startswith("VmHWM:"):
            return int(line.split()[1]) / 1024.0
    return 0.0
