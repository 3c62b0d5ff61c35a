# SPDX-License-Identifier: Apache-2.0
import time
from itertools import count

import msgspec
import numpy as np
import pytest

from edge.config.registration import RegistrationConfig
from edge.config.runtime import RuntimeConfig
from edge.outputs.report import FrameReport
from edge.registration.registration import Registration
from edge.runtime.keyframe_worker import KeyframeTimes
from edge.runtime.pipeline import Pipeline
from edge.runtime.search import DelayedSearch, NoSearch
from tests.edge.runtime import scripted

CONFIG = RuntimeConfig(
    relocalise_delay_frames=3,
    tracking_query_interval_frames=12,
    lost_query_interval_frames=4,
    lost_query_interval_s=1.0,
)
NO_TIMES = KeyframeTimes(time.thread_time_ns, inline=True)


class Drive:
    """A run over scripted frames, and what was asked of the relocaliser in it."""

    def __init__(
        self, frames: int, blind: range = range(0), config: RuntimeConfig = CONFIG
    ) -> None:
        self.relocaliser = scripted.TrueRelocaliser()
        search = DelayedSearch(
            self.relocaliser, CONFIG.relocalise_delay_frames, time.thread_time_ns
        )
        self.odometry = scripted.TrueOdometry(blind)
        self.pipeline = Pipeline(
            self.odometry,
            Registration(RegistrationConfig()),
            search,
            config,
            time.thread_time_ns,
            NO_TIMES,
        )
        self.reports = [self.pipeline.step(frame) for frame in scripted.FrameList(frames)]

    def published(self) -> list[FrameReport]:
        return [report for report in self.reports if report.pose is not None]


def test_published_poses_are_the_truth() -> None:
    published = Drive(60).published()
    assert len(published) > 40
    for report in published:
        assert report.pose is not None
        assert np.allclose(report.pose.T_map_cam, scripted.true_pose(report.pose.index), atol=1e-6)
        assert report.pose.scale == pytest.approx(scripted.SCALE, rel=1e-3)


def test_every_keyframe_not_asked_for_yet_is_asked_for_with_its_own_pose_and_depth() -> None:
    drive = Drive(30, config=msgspec.structs.replace(CONFIG, tracking_query_least_s=0.0))
    tracked = [query for query in drive.relocaliser.asked if query.depth is not None]
    # (the first was asked for when it was but a frame)
    assert [query.frame.index for query in tracked] == [5, 10, 15, 20, 25]
    asked = [query.frame.index for query in drive.relocaliser.asked]
    assert len(asked) == len(set(asked))
    for query in tracked:
        assert query.odom_id == 1
        assert query.T_odom_cam is not None
        assert np.allclose(query.T_odom_cam, scripted.odometry_pose(query.frame.index))


def test_keyframes_in_quick_succession_are_left_out_once_the_place_is_certain() -> None:
    asked = [query.frame.index for query in Drive(90).relocaliser.asked if query.depth is not None]
    certain = [index for index in asked if index >= 30]
    assert set(np.diff(certain)) == {2 * scripted.KEYFRAME_EVERY}  # one is 167 ms


def test_keyframe_query_carries_where_registration_believes_it_is() -> None:
    query = Drive(60).relocaliser.asked[-1]
    assert query.T_map_cam_prior is not None
    assert query.prior_covariance is not None
    assert np.allclose(query.T_map_cam_prior, scripted.true_pose(query.frame.index), atol=1e-6)


def test_lost_frames_are_asked_for_now_and_then_without_odometry() -> None:
    drive = Drive(40, blind=range(20, 40))
    lost = [query for query in drive.relocaliser.asked if query.odom_id is None]
    indices = [query.frame.index for query in lost]
    assert len(indices) >= 4
    assert set(np.diff(indices)) == {CONFIG.lost_query_interval_frames}
    assert all(query.T_odom_cam is None and query.depth is None for query in lost)


def test_lost_frames_are_asked_for_by_time_where_they_come_seldom() -> None:
    often = msgspec.structs.replace(CONFIG, lost_query_interval_s=3e-9 * scripted.PERIOD_NS)
    drive = Drive(40, blind=range(20, 40), config=often)
    lost = [query.frame.index for query in drive.relocaliser.asked if query.odom_id is None]
    assert set(np.diff(lost)) == {3}


def test_what_a_fix_tells_of_depths_goes_to_an_odometry_that_does_not_track() -> None:
    drive = Drive(40, blind=range(20, 40))
    lost = [query.frame.index for query in drive.relocaliser.asked if query.odom_id is None]
    told = [start.index for start in drive.odometry.told]
    assert len(told) >= 3
    assert told == lost[: len(told)]


def test_what_accepted_fixes_tell_of_depths_goes_to_an_odometry_that_tracks() -> None:
    drive = Drive(60)
    accepted = [fix.fix.index for report in drive.reports for fix in report.fixes if fix.accepted]
    told = [index for index, _ in drive.odometry.replenished]
    assert len(told) >= 3
    assert set(told) <= set(accepted)


def test_no_fix_takes_effect_before_its_delay() -> None:
    effects = [
        report.update.index - fix.fix.index for report in Drive(90).reports for fix in report.fixes
    ]
    assert min(effects) == CONFIG.relocalise_delay_frames
    # a keyframe's query leaves with its result, KEYFRAME_DELAY after the keyframe itself
    # (until the place is settled, frames are asked for, too)
    assert set(effects[len(effects) // 2 :]) == {
        CONFIG.relocalise_delay_frames + scripted.KEYFRAME_DELAY
    }


def test_loss_silences_the_map_pose_at_once() -> None:
    drive = Drive(40, blind=range(30, 40))
    assert drive.reports[29].pose is not None
    assert drive.reports[30].pose is None


def test_without_a_map_odometry_goes_on_alone() -> None:
    pipeline = Pipeline(
        scripted.TrueOdometry(),
        Registration(RegistrationConfig()),
        NoSearch(),
        CONFIG,
        time.thread_time_ns,
        NO_TIMES,
    )
    reports = [pipeline.step(frame) for frame in scripted.FrameList(10)]
    assert all(report.pose is None for report in reports)
    assert all(report.update.T_odom_cam is not None for report in reports)
    assert pipeline.trajectory() == []


def test_search_is_not_counted_into_the_frame() -> None:
    class Slow(scripted.TrueRelocaliser):
        def step(self, query: scripted.Query) -> scripted.Fix:
            until = time.thread_time() + 0.02
            while time.thread_time() < until:
                pass
            return super().step(query)

    pipeline = Pipeline(
        scripted.TrueOdometry(),
        Registration(RegistrationConfig()),
        DelayedSearch(Slow(), 2, time.thread_time_ns),
        CONFIG,
        time.thread_time_ns,
        NO_TIMES,
    )
    reports = [pipeline.step(frame) for frame in scripted.FrameList(12)]
    fixes = [fix.fix for report in reports for fix in report.fixes]
    assert all(fix.ms >= 20.0 for fix in fixes)
    assert all(report.timing.frame < 20.0 for report in reports)


def test_new_map_gives_poses_again_and_counts_as_a_reset() -> None:
    drive = Drive(30)
    before = drive.published()[-1]
    relocaliser = scripted.TrueRelocaliser()
    search = DelayedSearch(relocaliser, 3, time.thread_time_ns)
    drive.pipeline.replace_map(search, Registration(RegistrationConfig()))
    after = [drive.pipeline.step(frame) for frame in list(scripted.FrameList(60))[30:]]
    first = next(report for report in after if report.pose is not None)
    assert relocaliser.asked[0].frame.index == 30
    assert first.update.odom_id == before.update.odom_id
    assert before.pose is not None
    assert first.pose is not None
    assert first.pose.reset_counter == before.pose.reset_counter + 1
    assert np.allclose(first.pose.T_map_cam, scripted.true_pose(first.pose.index), atol=1e-6)


def test_new_odometry_opens_a_new_frame_each_time() -> None:
    drive = Drive(20)
    frames = iter(list(scripted.FrameList(100))[20:])
    for odom_id in (2, 3):
        drive.pipeline.replace_odometry(scripted.TrueOdometry(), NO_TIMES)
        reports = [drive.pipeline.step(next(frames)) for _ in range(30)]
        assert {report.update.odom_id for report in reports} == {odom_id}
        assert reports[-1].pose is not None


def test_a_pipeline_that_ran_beside_takes_over_with_its_pose_and_its_own_odometry_frame() -> None:
    numbers = count(1)
    running, beside = (
        Pipeline(
            scripted.TrueOdometry(),
            Registration(RegistrationConfig()),
            DelayedSearch(scripted.TrueRelocaliser(), 3, time.thread_time_ns),
            RuntimeConfig(),
            time.thread_time_ns,
            NO_TIMES,
            numbers,
        )
        for _ in range(2)
    )
    frames = list(scripted.FrameList(90))
    for frame in frames[:60]:
        before = running.step(frame)
        if frame.index >= 20:
            assert beside.step(frame).update.odom_id != before.update.odom_id
    running.take_over(beside)
    reports = [running.step(frame) for frame in frames[60:]]
    assert {report.update.odom_id for report in reports} == {2}
    assert all(report.pose is not None for report in reports)


def test_start_pose_guides_the_search_until_a_fix_is_accepted() -> None:
    drive = Drive(0)
    start, covariance = scripted.true_pose(7), np.eye(6)
    drive.pipeline.set_start(start, covariance)
    reports = [drive.pipeline.step(frame) for frame in scripted.FrameList(40)]
    accepted = next(r.update.index for r in reports for fix in r.fixes if fix.accepted)
    for query in drive.relocaliser.asked:
        assert (query.T_map_cam_prior is start) == (query.frame.index < accepted)


def test_stretched_queries_are_fewer() -> None:
    drive = Drive(0)
    drive.pipeline.stretch_queries(3)
    for frame in scripted.FrameList(120):
        drive.pipeline.step(frame)
    indices = [query.frame.index for query in drive.relocaliser.asked]
    assert len(indices) > 3
    until_settled = 3  # frames are then asked for often
    assert min(np.diff(indices[until_settled - 1 :])) > 2 * scripted.KEYFRAME_EVERY
