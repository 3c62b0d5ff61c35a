# SPDX-License-Identifier: Apache-2.0
"""The stage that turns odometry and fixes into map poses."""

import logging
from collections import deque
from dataclasses import replace

import numpy as np

from edge.config.registration import RegistrationConfig
from edge.registration.agreement import founding, start_at
from edge.registration.candidates import Candidates
from edge.registration.constellation import Constellation
from edge.registration.doubts import Doubts
from edge.registration.gates import chi2_quantile
from edge.registration.leaps import Leaps
from edge.registration.motion import OdometryTrack
from edge.registration.publisher import Publisher
from edge.registration.rest import Rest
from edge.registration.trajectory import TrajectoryLog
from edge.registration.verdict import FixVerdict, flaw_of
from edge.types import (
    DepthSamples,
    Fix,
    KeyframeResult,
    MapPose,
    MapStart,
    Mat4,
    Mat6,
    OdometryState,
    OdometryUpdate,
)

log = logging.getLogger(__name__)

_UNLINKED_KEPT = 16  # an odometry starts with a window of fewer frames


class Registration:
    """Owns the fixes that hold the current odometry frame in the map.

    Owned by the tracking thread: no locks, no I/O, no clock. Fixes may arrive late; each is
    compared with what is foretold for its own frame, so lateness costs nothing. Before the
    first pose several fixes must agree; after a loss nothing is published until they do again.
    """

    def __init__(self, config: RegistrationConfig) -> None:
        self._config = config
        self._track: OdometryTrack | None = None
        self._anchors: Constellation | None = None
        self._confirmed = False  # whether a single fix may join the anchors
        self._wary = False  # whether an odometry has started from a fix that others spoke against
        self._rejected = 0  # fixes in a row that disagreed with the odometry
        # Whether the last ones did, of those that had a place foretold.
        self._against: deque[bool] = deque(maxlen=config.contradicted_of_last)
        self._leaps = Leaps()
        self._doubts = Doubts(config)
        self._candidates = Candidates(config)
        self._rest = Rest(config)
        self._unlinked: deque[Fix] = deque(maxlen=_UNLINKED_KEPT)
        self._newest: deque[int] = deque(maxlen=config.rest_hold_frames)
        self._publisher = Publisher(config)
        self._log = TrajectoryLog(config) if config.keep_trajectory else None

    def accept(self, fix: Fix) -> FixVerdict:
        """Take in a fix, for whichever recent frame it is."""
        try:
            verdict = self._accept(fix)
            if self._doubts.hear(fix, verdict, self._track, self._anchors):
                self._rejected = max(self._rejected, 1)
            return verdict
        except np.linalg.LinAlgError:
            self._break_down(fix.index)
            return FixVerdict(False, "its numbers break down")

    def step(self, update: OdometryUpdate) -> MapPose | None:
        """Map pose of the frame of `update`, or None while it is not certain."""
        try:
            return self._step(update)
        except np.linalg.LinAlgError:
            self._break_down(update.index)
            return None

    def _break_down(self, index: int) -> None:
        """What is held has no solution: begin anew, and be silent until sure again."""
        log.warning("event=numbers_break_down frame=%d", index)
        self._forget()
        self._publisher.interrupt()

    def _accept(self, fix: Fix) -> FixVerdict:
        if fix.lens_wrong:  # and with it whatever agrees so well
            self._unlinked.clear()
            self._disown()
        if (flaw := flaw_of(fix)) is not None:
            return FixVerdict(False, flaw)
        if fix.odom_id is None and (self._track is None or not self._track.holds(fix.index)):
            return self._keep(fix)
        if self._track is None or fix.odom_id not in (None, self._track.odom_id):
            return FixVerdict(False, "odometry restarted")
        if not self._track.holds(fix.index):
            return FixVerdict(False, "frame unknown")
        return self._judge(fix, self._track)

    def _step(self, update: OdometryUpdate) -> MapPose | None:
        restarted = self._track is not None and update.odom_id != self._track.odom_id
        if update.state is OdometryState.LOST or restarted:
            self._forget()
        if update.state is OdometryState.LOST and self._log is not None:
            self._log.interrupt(update.odom_id)
        pose = None
        self._newest.append(update.index)
        if update.T_odom_cam is not None:
            pose = self._step_tracked(update)
        if self._anchors is not None:
            self._rest.clear()
        elif located := self._rest.locate(update.t_ns, self._newest):
            pose = self._publisher.at_rest(update, *located, self._rest.depth_m)
        if pose is None:
            self._publisher.interrupt()
        return pose

    def founding(self, fix: Fix) -> MapStart | None:
        """What an odometry may start from, now that `fix` is known as well.

        One fix is enough for a try, which the next one judges; where that has failed, none until
        two fixes are votes of their own, for an odometry itself hardly notices wrong depths.
        """
        if fix.odom_id is not None or flaw_of(fix) is not None:
            return None
        first: Fix | None = fix
        if self._wary:
            first = founding(self._unlinked, fix, self._config) or self._rest.founding
        return None if first is None else start_at(first, self._unlinked, fix, self._config)

    def prior(self, update: OdometryUpdate) -> tuple[Mat4, Mat6] | None:
        """Where the frame of `update` is believed to be: T_map_cam and its covariance.

        Of the frame of `update.keyframe` where there is one, since that is what queries carry.
        While nothing is certain it is the last known place with a sigma that grows with time.
        """
        index = update.index if update.keyframe is None else update.keyframe.frame.index
        if self._anchors is not None and self._track is not None and self._track.holds(index):
            estimate = self._anchors.locate(self._track.frame(index))
            return estimate.T_map_cam, estimate.covariance
        return self._publisher.last_place(update.t_ns)

    @property
    def confirmed(self) -> bool:
        """Whether fixes agree on where this odometry is in the map, and none speaks against it."""
        return self._confirmed and self._anchors is not None and self._rejected == 0

    @property
    def settled(self) -> bool:
        """Whether `confirmed` by more than the two fixes of a start, which may err alike."""
        if self._anchors is None:
            return False
        return self.confirmed and self._anchors.n_fixes >= self._config.publish_fixes

    def depth_in_odometry(self, fix: Fix) -> DepthSamples | None:
        """The depths of an accepted fix in the odometry's units, where their ratio is known."""
        if self._anchors is None or self._track is None or fix.depth is None or not self.confirmed:
            return None
        if not self._track.holds(fix.index):
            return None
        scale = np.float32(self._anchors.locate(self._track.frame(fix.index)).scale)
        depth = fix.depth
        return DepthSamples(depth.pixels, depth.inverse_depth * scale, depth.sigma * scale)

    def take_contradiction(self) -> bool:
        """Whether fix after fix disagrees with the odometry, and they with one another by it.

        Or now and then one agrees, but too many do not. Then it bends what it measures, and should
        start anew; so much is said once.
        """
        if max(self._rejected, sum(self._against)) < self._config.contradicted_after:
            return False
        self._candidates.clear()
        self._against.clear()
        self._rejected = 1
        return True

    def trajectory(self) -> list[tuple[int, Mat4]]:
        """(t_ns, T_map_cam) of every tracked frame of each odometry frame that holds a fix."""
        return [] if self._log is None else self._log.solve()

    def _forget(self) -> None:
        """Drop all that depends on the odometry frame; the last place stays known."""
        self._track = None
        self._disown()

    def _disown(self) -> None:
        """Drop the fixes that an odometry frame hangs on."""
        self._anchors = None
        self._confirmed = False
        self._rejected = 0
        self._against.clear()
        self._doubts.forget()
        self._candidates.clear()
        self._rest.clear()

    def _step_tracked(self, update: OdometryUpdate) -> MapPose | None:
        if self._track is None:
            self._track = OdometryTrack(update.odom_id, self._config.history_frames)
            self._leaps = Leaps()
        frame = self._track.add(update)
        if self._log is not None:
            self._log.add(update)
        if update.keyframe is not None:
            self._link(self._track, update.keyframe)
        if self._anchors is None or frame is None:
            return None
        estimate = self._anchors.locate(frame)
        self._leaps.add(update.t_ns, frame, estimate.depth_m / estimate.scale)
        if self._publisher.is_in_doubt(estimate):
            self._confirmed = False
        # Either the last fix was wrong or this is: until the next one decides, be silent.
        sure = self.settled and not self._leaps.unsettled
        if not sure or not self._publisher.is_certain(estimate):
            return None
        return self._publisher.tracked(update, frame, estimate)

    def _keep(self, fix: Fix) -> FixVerdict:
        """Keep a fix without odometry: the camera may be at rest, or an odometry start from it."""
        self._unlinked.append(fix)
        reason = self._rest.accept(fix)
        return FixVerdict(reason == "ok", reason)

    def _link(self, track: OdometryTrack, start: KeyframeResult) -> None:
        """Let fixes from before the odometry's start count, if it began with their frames."""
        linked = [fix for fix in self._unlinked if track.holds(fix.index)]
        self._unlinked.clear()
        for fix in linked:
            if start.in_map_units and fix.index == start.frame.index:
                fix = replace(fix, log_scale=0.0, log_scale_sigma=self._config.seed_log_scale)
            self._judge(fix, track)

    def _judge(self, fix: Fix, track: OdometryTrack) -> FixVerdict:
        """Take in a fix of a frame that the odometry knows."""
        if self._anchors is not None and self._anchors.is_late(fix.index):
            return FixVerdict(False, "older than the last")
        if self._anchors is not None and self._confirmed:
            return self._correct(self._anchors, fix, track)
        return self._gather(fix, track)

    def _correct(self, anchors: Constellation, fix: Fix, track: OdometryTrack) -> FixVerdict:
        """Let a fix join the anchors if it passes the gate."""
        innovation = anchors.compare(fix)
        if innovation.chi2_pose > chi2_quantile(self._config.gate_probability, 6):
            verdict = self._gather(fix, track)
            if verdict.accepted:
                return verdict
            self._against.append(True)
            self._rejected = max(self._rejected, 1)
            return FixVerdict(
                False, f"disagrees with the odometry, chi2 {innovation.chi2_pose:.0f}"
            )
        scale_fits = innovation.chi2_scale <= chi2_quantile(self._config.gate_probability, 1)
        anchors.add(fix, use_scale=scale_fits)
        self._candidates.clear()
        self._against.append(False)
        self._rejected = 0
        self._leaps.settle(track.frame(fix.index).number)
        self._record(track, fix, anchors)
        return FixVerdict(True, "ok" if scale_fits else "ok without its scale")

    def _gather(self, fix: Fix, track: OdometryTrack) -> FixVerdict:
        """Keep a fix until enough others agree with it; they then make a new anchor."""
        self._candidates.forget_before(track)
        if self._candidates.is_late(fix, track):
            return FixVerdict(False, "older than the last")
        self._candidates.add(fix)
        agreed = self._candidates.agreed(track, overruling=self._confirmed)
        others = () if agreed is None else agreed[1]
        if self._anchors is None and self._candidates.speak_against(track.founder, others, track):
            log.info("event=start_refuted frame=%d", fix.index)
            self._rejected, self._wary = self._config.contradicted_after, True
            return FixVerdict(False, "awaiting agreement")
        if agreed is None:
            self._rejected += self._candidates.disagree(overruling=self._confirmed)
            return FixVerdict(False, "awaiting agreement")
        fresh, group = agreed
        old = None if self._anchors is None else self._anchors.joined(group)
        if self._anchors is not None and old is None:
            log.info("anchors overruled t_ns=%d fixes=%d", fix.t_ns, len(group))
            self._publisher.interrupt()
        self._anchors = fresh if old is None else old
        self._confirmed = True
        self._wary = False
        self._against.clear()
        self._rejected = 0
        self._leaps.settle(track.frame(fix.index).number)
        self._candidates.clear()
        for agreeing_fix in group:
            self._record(track, agreeing_fix, self._anchors)
        return FixVerdict(True, "ok")

    def _record(self, track: OdometryTrack, fix: Fix, anchors: Constellation) -> None:
        if self._log is not None:
            self._log.accept(track.odom_id, fix, anchors.log_scale, anchors.drift)
