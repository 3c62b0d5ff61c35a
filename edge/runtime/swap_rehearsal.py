# SPDX-License-Identifier: Apache-2.0
"""A new map runs beside the old one on the same frames until it knows where the camera is.

So the exchange leaves no frame without a pose, and a map that does not show this place is
found out before anything is exchanged. A map that reads our images by another lens brings an
odometry of its own, which sees through that lens and goes on after the exchange.
"""

import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import msgspec

from edge.config.odometry import OdometryConfig
from edge.config.runtime import RuntimeConfig
from edge.config.tiles import TilesConfig
from edge.errors import TileError
from edge.outputs.report import FrameReport
from edge.registration.registration import Registration
from edge.runtime.keyframe_worker import KeyframeTimes
from edge.runtime.live import LiveStages, OpenedMap, Tracking
from edge.runtime.map_switch import ENDS, MapSwitch, SwapRefused
from edge.runtime.pipeline import OdometryStage, Pipeline
from edge.runtime.search import Search
from edge.types import DepthSamples, Frame, MapStart, Moving, OdometryUpdate

_NOTHING_TO_LOSE_NS = 500_000_000  # without a pose in the old map
_NO_FRAMES_NS = 2_000_000_000
_QUERY_EVERY = 4  # frames: nobody waits for the new map longer than needed
_FORCED_AFTER_NS = 2_000_000_000  # a map that is put in use anyway may look round first


class Rehearsal:
    """The stages that depend on a map, fed with the running odometry's updates.

    With a `tracking` of its own it is fed with that one's. Owned by the tracking thread.
    """

    def __init__(
        self,
        opened: OpenedMap,
        registration: Registration,
        runtime: RuntimeConfig,
        limits: TilesConfig,
        tracking: Tracking | None = None,
        odom_ids: Iterator[int] | None = None,
    ) -> None:
        self.opened = opened
        self.registration = registration
        self.tracking = tracking
        self.verdict: str | None = None  # empty: may take over; else why it may not
        self.frames = 0
        self._echo = _Echo()
        clock = time.monotonic_ns
        times = KeyframeTimes(clock, inline=False)
        stage: OdometryStage = self._echo
        if tracking is None:
            odom_ids = self._echo.odom_ids()
        else:
            stage, times = tracking.odometry, tracking.times
        often = min(runtime.tracking_query_interval_frames, _QUERY_EVERY)
        runtime = msgspec.structs.replace(runtime, tracking_query_interval_frames=often)
        self.pipeline = Pipeline(
            stage, registration, opened.search, runtime, clock, times, odom_ids
        )
        self._limits = limits
        self._began_ns: int | None = None
        self._located_ns: int | None = None  # when the old map last had a pose
        self._old_fixes = 0

    def step(self, frame: Frame, report: FrameReport) -> None:
        """See what the new map makes of a frame of which the old one gave `report`."""
        self.frames += 1
        if self._began_ns is None or self._located_ns is None:
            self._began_ns = self._located_ns = frame.t_ns
        if report.pose is not None:
            self._located_ns = frame.t_ns
        self._old_fixes += sum(fix.accepted for fix in report.fixes)
        self._echo.update = _without_units(report.update)
        try:
            own = self.pipeline.step(frame)
        except TileError as error:
            self.verdict = str(error)
            return
        lost_ns = frame.t_ns - self._located_ns
        if own.pose is not None or lost_ns > _NOTHING_TO_LOSE_NS:
            self.verdict = ""
        elif self._old_fixes >= self._limits.rehearsal_fixes:
            self.verdict = (
                f"the old map finds this place ({self._old_fixes} times), the new one does not"
            )
        elif frame.t_ns - self._began_ns > self._limits.rehearsal_s * 1e9:
            self.verdict = f"it did not find this place within {self._limits.rehearsal_s:g} s"


class _Echo:
    """The running odometry, as the rehearsal sees it."""

    update: OdometryUpdate

    def step(self, _frame: Frame) -> OdometryUpdate:
        """What the running odometry has said about this frame."""
        return self.update

    def odom_ids(self) -> Iterator[int]:
        """The numbers that the running pipeline gives."""
        while True:
            yield self.update.odom_id

    def hide(self, moving: Moving) -> None:
        """Nothing: the running odometry is told by its own pipeline."""

    def begin_at(self, told: MapStart) -> None:
        """Nothing: the running odometry starts by itself."""

    def replenish(self, index: int, depth: DepthSamples) -> None:
        """Nothing: the running odometry measures by itself."""

    def forget_map(self) -> None:
        """Nothing: the running odometry starts by itself."""

    def restart(self) -> None:
        """Nothing: what the new map makes of it is no reason to disturb the map in use."""


def _without_units(update: OdometryUpdate) -> OdometryUpdate:
    """What the running odometry says; units that it has from a map are not those of the new one."""
    keyframe = update.keyframe
    if keyframe is None or not keyframe.in_map_units:
        return update
    return replace(update, keyframe=replace(keyframe, in_map_units=False))


class RehearsingStages(LiveStages):
    """The live stages, with a new map beside them at times. Owned by the tracking thread."""

    _rehearsal: Rehearsal | None = None

    def step(self, frame: Frame) -> FrameReport:
        """Everything that `frame` gave; a rehearsal sees it, too."""
        report = super().step(frame)
        if self._rehearsal is not None and self._rehearsal.verdict is None:
            self._rehearsal.step(frame, report)
        return report

    def rehearse(self, opened: OpenedMap, limits: TilesConfig) -> Rehearsal:
        """Run a map beside the one in use from now on."""
        self.end_rehearsal()
        tracking = None if opened.camera == self._camera else self._make_tracking(opened.camera)
        self._rehearsal = Rehearsal(
            opened, self._registration(), self._config.runtime, limits, tracking, self._odom_ids
        )
        return self._rehearsal

    def end_rehearsal(self) -> None:
        """Go on with the map in use alone."""
        if self._rehearsal is not None and self._rehearsal.tracking is not None:
            self._rehearsal.tracking.worker.abandon()
        self._rehearsal = None

    def use_preset(self, config: OdometryConfig) -> None:
        """Track with other settings; an odometry that rehearses begins anew, too."""
        if config != self._odometry_config and self._rehearsal and self._rehearsal.tracking:
            self.end_rehearsal()
        super().use_preset(config)

    def hide(self, moving: Moving) -> None:
        """Let no odometry measure by what moved in a recent frame, that which rehearses either."""
        super().hide(moving)
        if self._rehearsal is not None:
            self._rehearsal.pipeline.hide(moving)

    def close(self) -> None:
        """End the threads."""
        self.end_rehearsal()
        super().close()

    @property
    def rehearsal(self) -> Rehearsal | None:
        """What runs beside the map in use."""
        return self._rehearsal

    def use_map(self, opened: OpenedMap) -> Search:
        """Put a map in the old one's place; return the old search, to be closed.

        After its rehearsal the odometry goes on: the running one, or where the map reads images
        by another lens the one that has rehearsed with it.
        """
        rehearsal = self._rehearsal
        if rehearsal is None or rehearsal.opened is not opened:
            self.end_rehearsal()
            return super().use_map(opened)
        self._rehearsal = None
        self._search, self.map, self._camera = opened.search, opened.map, opened.camera
        if rehearsal.tracking is None:
            return self._pipeline.replace_map(opened.search, rehearsal.registration)
        self._worker.abandon()
        self._worker = rehearsal.tracking.worker
        return self._pipeline.take_over(rehearsal.pipeline)


class RehearsedSwitch(MapSwitch):
    """Exchanges maps only once the new one has shown beside the old one that it will do."""

    def __init__(
        self,
        open_beside: Callable[[Path], OpenedMap],
        stages: RehearsingStages,
        limits: TilesConfig,
    ) -> None:
        super().__init__(open_beside)
        self._stages = stages
        self._limits = limits
        self._must_do = True  # what is rehearsed has to find the place
        self._refusal: str | None = None
        self._begun_ns = 0  # of a rehearsal; the tracking thread's

    def swap(self, map_folder: Path, rehearse: bool = True) -> None:
        """Return once the map in `map_folder` is in use; else EdgeError, and nothing changed.

        Without `rehearse` it is put in use whatever it finds, after a short rehearsal all the same.
        """
        with self._asking:
            opened = self._open_beside(map_folder)
            with self._changed:
                self._must_do, self._replaced = rehearse, None
                self._refusal = None
                self._waiting = opened
                timeout_s = self._timeout_s + self._limits.rehearsal_s
                self._changed.wait_for(self._is_decided, timeout_s)
                replaced, refusal, self._waiting = self._replaced, self._refusal, None
        if replaced is None:
            opened.search.close()
            late = "the tracking gave no pause between two frames; see `status` for why"
            why = ENDS if self._closed else refusal or late
            raise SwapRefused(f"{map_folder.name}: not put in use: {why}")
        replaced.close()

    def apply(self, use: Callable[[OpenedMap], Search]) -> bool:
        """Go on with what waits, if anything does; whether `use` has put it in use.

        For the tracking thread, between two frames; never waits.
        """
        opened = self._waiting
        if opened is None or self._stages.map is None:
            if self._stages.rehearsal is not None:  # nobody waits for it any more
                self._stages.end_rehearsal()
            return super().apply(use)
        rehearsal = self._stages.rehearsal
        if rehearsal is None or rehearsal.opened is not opened:
            self._stages.rehearse(opened, self._limits)
            self._begun_ns = time.monotonic_ns()
            return False
        verdict = self._verdict(rehearsal)
        if verdict == "":
            return super().apply(use)
        if verdict is not None:
            self._stages.end_rehearsal()
            with self._changed:
                self._waiting, self._refusal = None, verdict
                self._changed.notify_all()
        return False

    def _verdict(self, rehearsal: Rehearsal) -> str | None:
        lasted_ns = time.monotonic_ns() - self._begun_ns
        if rehearsal.frames == 0 and lasted_ns > _NO_FRAMES_NS:
            return ""  # nobody is looking
        if not self._must_do and (rehearsal.verdict or lasted_ns > _FORCED_AFTER_NS):
            return ""
        return rehearsal.verdict

    def _is_decided(self) -> bool:
        return self._replaced is not None or self._refusal is not None or self._closed
