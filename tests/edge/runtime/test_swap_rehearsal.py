# SPDX-License-Identifier: Apache-2.0
import time
from collections.abc import Callable
from dataclasses import replace

import pytest

from edge.config.registration import RegistrationConfig
from edge.config.runtime import RuntimeConfig
from edge.config.tiles import TilesConfig
from edge.errors import TileError
from edge.outputs.report import FrameReport
from edge.registration.registration import Registration
from edge.runtime.keyframe_worker import KeyframeTimes
from edge.runtime.live import OpenedMap
from edge.runtime.pipeline import Pipeline
from edge.runtime.search import DelayedSearch, NoSearch, RelocaliseStage, Search
from edge.runtime.swap_rehearsal import Rehearsal
from edge.runtime.warm_up import MAP_FOLDER
from edge.tiles.reader import open_map
from edge.types import Fix, Frame, KeyframeResult, MapPose, OdometryUpdate, Query
from tests.edge.runtime import scripted

LIMITS = TilesConfig(rehearsal_s=5.0, rehearsal_fixes=6)


class BlindRelocaliser:
    """Finds nothing, as in a map of another place."""

    def step(self, query: Query) -> Fix:
        return replace(scripted.TrueRelocaliser().step(query), found=False, reason="few matches")


def search(relocaliser: RelocaliseStage | None) -> Search:
    return NoSearch() if relocaliser is None else DelayedSearch(relocaliser, 3, time.monotonic_ns)


def play(
    old: RelocaliseStage | None, new: RelocaliseStage, frames: int = 400
) -> tuple[Rehearsal, list[FrameReport]]:
    """Rehearse `new` beside `old`, begun once that had its time to find the place."""
    times = KeyframeTimes(time.monotonic_ns, inline=True)
    registration = Registration(RegistrationConfig())
    odometry = scripted.TrueOdometry()
    running = Pipeline(
        odometry, registration, search(old), RuntimeConfig(), time.monotonic_ns, times
    )
    opened = OpenedMap(open_map(MAP_FOLDER), search(new), scripted.CAMERA)
    rehearsal = Rehearsal(opened, Registration(RegistrationConfig()), RuntimeConfig(), LIMITS)
    reports = []
    for frame in scripted.FrameList(frames):
        report = running.step(frame)
        if frame.index >= 60:
            rehearsal.step(frame, report)
            reports.append(report)
            if rehearsal.verdict is not None:
                break
    return rehearsal, reports


def test_a_map_that_finds_the_place_takes_over_with_a_pose() -> None:
    rehearsal, reports = play(scripted.TrueRelocaliser(), scripted.TrueRelocaliser())
    assert rehearsal.verdict == ""
    assert all(report.pose is not None for report in reports)
    assert rehearsal.registration.prior(reports[-1].update) is not None
    assert len(reports) < 30


def test_a_map_that_does_not_show_what_the_old_one_shows_is_refused() -> None:
    rehearsal, _ = play(scripted.TrueRelocaliser(), BlindRelocaliser())
    assert rehearsal.verdict is not None
    assert "the old map finds this place (6 times)" in rehearsal.verdict


def test_a_map_that_proves_damaged_is_refused_and_the_old_one_goes_on() -> None:
    class Damaged:
        def step(self, query: Query) -> Fix:
            raise TileError("tiles/7.tile is damaged")

    rehearsal, reports = play(scripted.TrueRelocaliser(), Damaged())
    assert rehearsal.verdict == "tiles/7.tile is damaged"
    assert all(report.pose is not None for report in reports)


@pytest.mark.parametrize("old", [None, BlindRelocaliser], ids=["no map", "a blind one"])
def test_where_the_old_map_knows_nothing_there_is_nothing_to_lose(
    old: Callable[[], RelocaliseStage] | None,
) -> None:
    rehearsal, reports = play(None if old is None else old(), BlindRelocaliser())
    assert rehearsal.verdict == ""
    assert 0.5 < len(reports) * scripted.PERIOD_NS * 1e-9 < 0.7


def test_it_does_not_go_on_for_ever() -> None:
    class Once:
        """Finds the place at first only."""

        def step(self, query: Query) -> Fix:
            fix = scripted.TrueRelocaliser().step(query)
            return replace(fix, found=query.frame.index < 62)

    rehearsal, reports = play(Once(), BlindRelocaliser())
    assert rehearsal.verdict == "it did not find this place within 5 s"
    assert all(report.pose is not None for report in reports)


def test_units_that_the_odometry_has_from_the_old_map_are_not_those_of_the_new_one() -> None:
    class FromMap(scripted.TrueOdometry):
        def step(self, frame: Frame) -> OdometryUpdate:
            update = super().step(frame)
            if update.keyframe is None:
                return update
            return replace(update, keyframe=replace(update.keyframe, in_map_units=True))

    class Told(Registration):
        def step(self, update: OdometryUpdate) -> MapPose | None:
            if update.keyframe is not None:
                keyframes.append(update.keyframe)
            return super().step(update)

    keyframes: list[KeyframeResult] = []
    times = KeyframeTimes(time.monotonic_ns, inline=True)
    config, old = RuntimeConfig(), Registration(RegistrationConfig())
    running = Pipeline(FromMap(), old, NoSearch(), config, time.monotonic_ns, times)
    opened = OpenedMap(open_map(MAP_FOLDER), search(BlindRelocaliser()), scripted.CAMERA)
    rehearsal = Rehearsal(opened, Told(RegistrationConfig()), config, LIMITS)
    for frame in scripted.FrameList(12):
        rehearsal.step(frame, running.step(frame))
    assert len(keyframes) >= 2
    assert not any(keyframe.in_map_units for keyframe in keyframes)
