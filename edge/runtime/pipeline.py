# SPDX-License-Identifier: Apache-2.0
"""The stages joined: a frame goes in, everything known about it comes out."""

from collections.abc import Iterator
from dataclasses import replace
from itertools import count
from typing import Protocol

from edge.config.runtime import RuntimeConfig
from edge.outputs.report import FixReport, FrameReport, Timing
from edge.registration.registration import Registration
from edge.runtime.keyframe_worker import KeyframeTimes
from edge.runtime.search import Clock, Search
from edge.types import (
    DepthSamples,
    Fix,
    Frame,
    MapPose,
    MapStart,
    Mat4,
    Mat6,
    Moving,
    OdometryState,
    OdometryUpdate,
    Query,
)

# Where queries are stretched, keyframes are asked for from this share of the interval on.
_KEYFRAMES_AT_SHARE = 0.5
_JITTER_S = 0.0005  # of stamps


class OdometryStage(Protocol):
    """Follows the camera from frame to frame."""

    def step(self, frame: Frame) -> OdometryUpdate:
        """What is known after `frame`."""

    def hide(self, moving: Moving) -> None:
        """Measure no more by what moved in a recent frame."""

    def begin_at(self, told: MapStart) -> None:
        """What the map tells of a recent frame, to start from if need be."""

    def replenish(self, index: int, depth: DepthSamples) -> None:
        """Depths that the map tells of a tracked frame, in the odometry's units."""

    def forget_map(self) -> None:
        """Start no more from what the map has told: it is another map now."""

    def restart(self) -> None:
        """Forget what was measured; a new odometry frame begins when it tracks again."""


class Pipeline:
    """Owns the stages and calls them in turn.

    Owned by the tracking thread; only `search` works beside it. `clock` gives the
    times in the reports: of this thread's CPU in replay, of the wall live.

    Between two frames a stage may be replaced by another: `odom_id` and `reset_counter` go on
    counting over that. Pipelines that may take each other's place draw their `odom_ids` from one
    row of numbers.
    """

    def __init__(
        self,
        odometry: OdometryStage,
        registration: Registration,
        search: Search,
        config: RuntimeConfig,
        clock: Clock,
        keyframe_times: KeyframeTimes,
        odom_ids: Iterator[int] | None = None,
    ) -> None:
        self._odometry = odometry
        self._registration = registration
        self._search = search
        self._config = config
        self._clock = clock
        self._keyframe_times = keyframe_times
        self._frames_since_query = config.tracking_query_interval_frames
        self._asked_ns = 0
        self._asked_index: int | None = None  # of the frame in the last query
        self._query_stretch = 1
        self._start: tuple[Mat4, Mat6] | None = None
        self._odom_ids = odom_ids if odom_ids is not None else count(1)
        self._odom_id: tuple[int, int] | None = None  # the odometry's own, and the one it gets
        self._resets_before = 0
        self._last_resets: int | None = None

    def step(self, frame: Frame) -> FrameReport:
        """Everything that `frame` gave."""
        found = self._search.drain(frame.t_ns)  # in replay it works here, on no frame's account
        began_ns = self._clock()
        for fix in found:
            if (told := self._registration.founding(fix)) is not None:
                self._odometry.begin_at(told)
        update = self._numbered(self._odometry.step(frame))
        tracked_ns = self._clock()
        fixes = tuple(self._judge(fix) for fix in found)
        if self._registration.take_contradiction():
            self._odometry.restart()
        pose = self._counted(self._registration.step(update))
        ended_ns = self._clock()
        if (query := self._query(frame, update)) is not None:
            self._search.offer(query)
        return FrameReport(update, pose, fixes, self._timing(began_ns, tracked_ns, ended_ns))

    def hide(self, moving: Moving) -> None:
        """Let the odometry measure nothing by what moved in a recent frame."""
        self._odometry.hide(moving)

    def trajectory(self) -> list[tuple[int, Mat4]]:
        """The final poses (t_ns, T_map_cam), after the last pose graph."""
        return self._registration.trajectory()

    def replace_map(self, search: Search, registration: Registration) -> Search:
        """Look for frames with `search` from now on; return the search used so far, to be closed.

        The odometry goes on; the next pose counts as a reset.
        """
        self._odometry.forget_map()
        old, self._search = self._search, search
        self._registration = registration
        if self._last_resets is not None:
            self._resets_before = self._last_resets + 1
        self._start = None
        self._frames_since_query = self._config.tracking_query_interval_frames
        return old

    def replace_odometry(self, odometry: OdometryStage, keyframe_times: KeyframeTimes) -> None:
        """Track with `odometry` from now on: it opens an odometry frame of its own."""
        self._odometry, self._keyframe_times = odometry, keyframe_times
        self._odom_id = None

    def take_over(self, other: "Pipeline") -> Search:
        """Go on with all stages of another pipeline; return the search used so far, to be closed.

        It has seen the same frames, through another lens: what it knows of them stays known.
        """
        self._odometry, self._keyframe_times = other._odometry, other._keyframe_times
        self._odom_id = other._odom_id
        return self.replace_map(other._search, other._registration)

    def set_start(self, T_map_cam: Mat4, covariance: Mat6) -> None:
        """Let frames be looked for near there, until the first fix is accepted."""
        self._start = T_map_cam, covariance
        self._frames_since_query = self._config.tracking_query_interval_frames

    def stretch_queries(self, factor: int) -> None:
        """Ask for a frame only every `factor` times as many frames as configured."""
        self._query_stretch = factor

    def _numbered(self, update: OdometryUpdate) -> OdometryUpdate:
        if self._odom_id is None or self._odom_id[0] != update.odom_id:
            self._odom_id = update.odom_id, next(self._odom_ids)
        number = self._odom_id[1]
        return update if number == update.odom_id else replace(update, odom_id=number)

    def _counted(self, pose: MapPose | None) -> MapPose | None:
        if pose is not None:
            if self._resets_before:
                pose = replace(pose, reset_counter=pose.reset_counter + self._resets_before)
            self._last_resets = pose.reset_counter
        return pose

    def _judge(self, fix: Fix) -> FixReport:
        verdict = self._registration.accept(fix)
        if verdict.accepted:
            self._start = None
            if (depth := self._registration.depth_in_odometry(fix)) is not None:
                self._odometry.replenish(fix.index, depth)
        return FixReport(fix, verdict.accepted, verdict.reason)

    def _query(self, frame: Frame, update: OdometryUpdate) -> Query | None:
        """What the relocaliser should look for after this frame, if anything.

        Each keyframe, once its depths are known, but not more often than is of use; where
        no keyframe comes for long, the frame itself now and then, and often until the place
        is settled.
        """
        self._frames_since_query += 1
        tracking = update.state is OdometryState.TRACKING
        certain = tracking and self._registration.settled
        waited_s = abs(frame.t_ns - self._asked_ns) * 1e-9
        keyframe = update.keyframe if tracking else None
        if keyframe is not None and keyframe.in_map_units:
            keyframe = None  # its fix is what the odometry started from
        if keyframe is not None and keyframe.frame.index == self._asked_index:
            keyframe = None  # asked for already when it was but a frame
        if certain and waited_s < self._config.tracking_query_least_s:
            keyframe = None
        stretch = self._query_stretch if tracking else 1
        share = self._waited_share(waited_s, certain=certain) / stretch
        if stretch > 1 and share < _KEYFRAMES_AT_SHARE:
            keyframe = None
        if keyframe is None and share < 1.0:
            return None
        self._frames_since_query, self._asked_ns = 0, frame.t_ns
        asked = frame if keyframe is None else keyframe.frame
        self._asked_index = asked.index
        prior = self._registration.prior(update) or self._start
        T_map_cam_prior, prior_covariance = prior if prior is not None else (None, None)
        return Query(
            frame=asked,
            odom_id=update.odom_id if tracking else None,
            T_odom_cam=update.T_odom_cam if keyframe is None else keyframe.T_odom_cam,
            depth=None if keyframe is None else keyframe.depth,
            T_map_cam_prior=T_map_cam_prior,
            prior_covariance=prior_covariance,
            rows_turned_rad=None if keyframe is None else keyframe.rows_turned_rad,
        )

    def _waited_share(self, waited_s: float, *, certain: bool) -> float:
        """How long the last query is ago, in times of when a frame is asked for in any case."""
        config = self._config
        if certain:
            return self._frames_since_query / config.tracking_query_interval_frames
        by_frames = self._frames_since_query / config.lost_query_interval_frames
        return max(by_frames, (waited_s + _JITTER_S) / config.lost_query_interval_s)

    def _timing(self, began_ns: int, tracked_ns: int, ended_ns: int) -> Timing:
        keyframe_ms = self._keyframe_times.take_ms()
        track_ms = (tracked_ns - began_ns) * 1e-6
        if self._keyframe_times.inline:
            track_ms -= keyframe_ms
        frame_ms = (ended_ns - began_ns) * 1e-6
        return Timing(track_ms, keyframe_ms, frame_ms, latency=frame_ms)
