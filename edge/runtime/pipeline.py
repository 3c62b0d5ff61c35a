# SPDX-License-Identifier: Apache-2.0
"""The stages joined: a frame goes in, everything known about it comes out."""

from typing import Protocol

from edge.config.runtime import RuntimeConfig
from edge.outputs.report import FixReport, FrameReport, Timing
from edge.registration.registration import Registration
from edge.runtime.keyframe_worker import KeyframeTimes
from edge.runtime.search import Clock, Search
from edge.types import Fix, Frame, Mat4, OdometryState, OdometryUpdate, Query


class OdometryStage(Protocol):
    """Follows the camera from frame to frame."""

    def step(self, frame: Frame) -> OdometryUpdate:
        """What is known after `frame`."""


class Pipeline:
    """Owns the stages and calls them in turn.

    Owned by the tracking thread; only `search` works beside it. `clock` gives the
    times in the reports: of this thread's CPU in replay, of the wall live.
    """

    def __init__(
        self,
        odometry: OdometryStage,
        registration: Registration,
        search: Search,
        config: RuntimeConfig,
        clock: Clock,
        keyframe_times: KeyframeTimes,
    ) -> None:
        self._odometry = odometry
        self._registration = registration
        self._search = search
        self._config = config
        self._clock = clock
        self._keyframe_times = keyframe_times
        self._frames_since_query = config.tracking_query_interval_frames

    def step(self, frame: Frame) -> FrameReport:
        """Everything that `frame` gave."""
        found = self._search.drain()  # in replay it works here, on no frame's account
        began_ns = self._clock()
        update = self._odometry.step(frame)
        tracked_ns = self._clock()
        fixes = tuple(self._judge(fix) for fix in found)
        pose = self._registration.step(update)
        ended_ns = self._clock()
        if (query := self._query(frame, update)) is not None:
            self._search.offer(query)
        return FrameReport(update, pose, fixes, self._timing(began_ns, tracked_ns, ended_ns))

    def trajectory(self) -> list[tuple[int, Mat4]]:
        """The final poses (t_ns, T_map_cam), after the last pose graph."""
        return self._registration.trajectory()

    def _judge(self, fix: Fix) -> FixReport:
        verdict = self._registration.accept(fix)
        return FixReport(fix, verdict.accepted, verdict.reason)

    def _query(self, frame: Frame, update: OdometryUpdate) -> Query | None:
        """What the relocaliser should look for after this frame, if anything.

        Each keyframe, once its depths are known; without odometry, and where no
        keyframe comes for long, the frame itself now and then.
        """
        self._frames_since_query += 1
        tracking = update.state is OdometryState.TRACKING
        interval = (
            self._config.tracking_query_interval_frames
            if tracking
            else self._config.lost_query_interval_frames
        )
        keyframe = update.keyframe if tracking else None
        if keyframe is None and self._frames_since_query < interval:
            return None
        self._frames_since_query = 0
        prior = self._registration.prior(update)
        T_map_cam_prior, prior_covariance = prior if prior is not None else (None, None)
        return Query(
            frame=frame if keyframe is None else keyframe.frame,
            odom_id=update.odom_id if tracking else None,
            T_odom_cam=update.T_odom_cam if keyframe is None else keyframe.T_odom_cam,
            depth=None if keyframe is None else keyframe.depth,
            T_map_cam_prior=T_map_cam_prior,
            prior_covariance=prior_covariance,
        )

    def _timing(self, began_ns: int, tracked_ns: int, ended_ns: int) -> Timing:
        keyframe_ms = self._keyframe_times.take_ms()
        track_ms = (tracked_ns - began_ns) * 1e-6
        if self._keyframe_times.inline:
            track_ms -= keyframe_ms
        frame_ms = (ended_ns - began_ns) * 1e-6
        return Timing(track_ms, keyframe_ms, frame_ms, latency=frame_ms)
