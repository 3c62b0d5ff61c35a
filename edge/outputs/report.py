# SPDX-License-Identifier: Apache-2.0
"""What outputs are told about one frame."""

from dataclasses import dataclass
from typing import NamedTuple, Protocol

from edge.types import ChangeEvent, Fix, LineSearch, MapPose, OdometryUpdate


class Timing(NamedTuple):
    """Times of one frame [ms]: of the CPU in replay, of the wall in real time."""

    track: float = 0.0
    keyframe: float = 0.0
    frame: float = 0.0  # from the decoded frame to its pose, in the tracking thread
    latency: float = 0.0  # from capture to this report


@dataclass(frozen=True, slots=True, eq=False)
class FixReport:
    """A relocalisation attempt and what registration made of it."""

    fix: Fix
    accepted: bool
    reason: str


@dataclass(frozen=True, slots=True, eq=False)
class FrameReport:
    """Everything that one frame gave."""

    update: OdometryUpdate
    pose: MapPose | None
    fixes: tuple[FixReport, ...]  # took effect with this frame
    timing: Timing
    dropped_frames: int = 0  # so far: unreadable, or too late for real time
    captured_ns: int | None = None  # mid-exposure on the monotonic clock, in real time only
    map_name: str = ""
    changes: tuple[ChangeEvent, ...] = ()  # became sure with this frame


def line_searches(report: FrameReport) -> tuple[LineSearch, ...]:
    """All searches for lines whose results came with a frame: for starts, window and fixes."""
    update = report.update
    in_window = () if update.keyframe is None else update.keyframe.line_searches
    in_fixes = (search for fix in report.fixes for search in fix.fix.line_searches)
    return (*update.line_searches, *in_window, *in_fixes)


class Sink(Protocol):
    """Where reports go."""

    def write(self, report: FrameReport) -> None:
        """Take one frame's results; called once a frame, in the order of play."""
