# SPDX-License-Identifier: Apache-2.0
"""The model of key colours looks at a grey wall, where the map knows a ball: it is gone."""

import time
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import onnx
import pytest

from edge.config import Config
from edge.errors import ModelRefused
from edge.geometry import se3, sim3, so3
from edge.geometry.sim3 import Sim3
from edge.outputs.report import FrameReport, Timing
from edge.runtime.sights import Chooser, Sight
from edge.runtime.watch import LiveWatch, ReplayWatch
from edge.runtime.watcher import Watcher
from edge.tiles.reader import Map
from edge.types import (
    ChangeEvent,
    DepthSamples,
    Frame,
    KeyframePose,
    KeyframeResult,
    Look,
    MapPose,
    OdometryState,
    OdometryUpdate,
)
from tests.edge.changes.scenes import ball_detection
from tests.edge.changes.wall_map import CUP, N_VIEWS, make_labelled, shown
from tests.maps.wall_drive import CAMERA, poses
from tools.key_colour_model import make_model

PERIOD_NS = 200_000_000

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def labelled(tmp_path_factory: pytest.TempPathFactory) -> Map:
    return make_labelled(tmp_path_factory.mktemp("watch"))


@pytest.fixture(scope="module")
def config(tmp_path_factory: pytest.TempPathFactory) -> Config:
    model = tmp_path_factory.mktemp("model") / "key.onnx"
    onnx.save(make_model(), model)
    return with_model(model)


def with_model(model: Path) -> Config:
    segmenter = msgspec.structs.replace(Config().segmenter, model=str(model))
    changes = msgspec.structs.replace(Config().changes, delay_frames=3)
    return msgspec.structs.replace(Config(), segmenter=segmenter, changes=changes)


def frame(index: int) -> Frame:
    T = poses(N_VIEWS)[index % N_VIEWS]
    return Frame(index, index * PERIOD_NS, shown(T, []))


def report(index: int, sigma_m: float = 0.01) -> FrameReport:
    T = poses(N_VIEWS)[index % N_VIEWS]
    update = OdometryUpdate(index, index * PERIOD_NS, OdometryState.TRACKING, 1)
    pose = MapPose(index, index * PERIOD_NS, T, T, sigma_m**2 * np.eye(6), 1.0, 0)
    return FrameReport(update, pose, (), Timing())


def play(watch: ReplayWatch) -> list[tuple[int, ChangeEvent]]:
    return [(i, event) for i in range(2 * N_VIEWS) for event in watch.step(frame(i), report(i))]


def test_a_replay_tells_what_is_gone_some_frames_later_and_twice_the_same(
    labelled: Map, config: Config
) -> None:
    told = []
    for _ in range(2):
        watch = ReplayWatch(config, CAMERA, labelled)
        told.append(play(watch))
        watch.close()

    (index, event), (again, _) = told[0][0], told[1][0]
    assert (event.kind, event.label) == ("removed", "cup")
    assert np.linalg.norm(event.center_map_m - CUP[1]) < 0.02
    assert event.t_ns == (index - 3) * PERIOD_NS
    assert index == again
    assert len(told[0]) == len(told[1]) == 1


def test_what_is_found_at_the_end_is_not_lost(labelled: Map, config: Config) -> None:
    watch = ReplayWatch(config, CAMERA, labelled)
    (index, event), *_ = play(watch)
    watch.close()
    watch = ReplayWatch(config, CAMERA, labelled)

    early = [found for i in range(index - 1) for found in watch.step(frame(i), report(i))]
    left = watch.finish()
    watch.close()

    assert early == []
    assert [one.t_ns for one in left] == [event.t_ns]


def test_a_model_that_is_none_is_refused_before_the_first_frame(
    labelled: Map, tmp_path: Path
) -> None:
    with pytest.raises(ModelRefused, match=r"none\.onnx"):
        ReplayWatch(with_model(tmp_path / "none.onnx"), CAMERA, labelled)


def test_live_a_refused_model_is_said_and_frames_go_on(labelled: Map, tmp_path: Path) -> None:
    watch = LiveWatch(with_model(tmp_path / "none.onnx"), CAMERA, labelled)
    try:
        index = 0
        while not watch.state.startswith("refused"):
            assert watch.step(frame(index), report(index)) == []
            index += 1
            time.sleep(0.01)
        assert "none.onnx" in watch.state
    finally:
        watch.close()


def test_what_was_seen_before_the_first_pose_counts_once_the_odometry_tells_from_where(
    labelled: Map, config: Config
) -> None:
    """The ball is told from the first frame on that has a pose, by the frames before it."""
    first = 2 * N_VIEWS - 2
    found = []
    for known in (True, False):
        watch = ReplayWatch(config, CAMERA, labelled)
        events = []
        for i in range(2 * N_VIEWS):
            full = report(i)
            update = replace(full.update, T_odom_cam=poses(N_VIEWS)[i % N_VIEWS] if known else None)
            pose = full.pose if i >= first else None
            events += watch.step(frame(i), replace(full, update=update, pose=pose))
        found.append([*events, *watch.finish()])
        watch.close()

    with_odometry, without = found
    assert [event.label for event in with_odometry] == ["cup"]
    assert without == []


def test_what_the_model_is_less_sure_of_goes_along_apart(
    labelled: Map, config: Config, monkeypatch: pytest.MonkeyPatch
) -> None:
    looks: list[Look] = []

    class Stage:
        def step(self, look: Look) -> list[ChangeEvent]:
            looks.append(look)
            return []

    watcher = Watcher(config, CAMERA, labelled, apart=False)
    try:
        watcher.wait_until_ready()
        both = ball_detection([CUP, (0, CUP[1] + [0.4, 0.0, 0.0], 0.1)], poses(N_VIEWS)[0], CAMERA)
        scores = np.array([0.9, 0.12], np.float32)
        monkeypatch.setattr(watcher, "_segment", lambda *_: replace(both, scores=scores))
        monkeypatch.setattr(watcher, "_find_stage", Stage)
        watcher.look(Sight(frame(0), np.eye(4), lambda: np.empty((0, 3))))
    finally:
        watcher.close()

    (look,) = looks
    assert look.detections is not None
    assert look.faint is not None
    assert (look.detections.scores, look.faint.scores) == (scores[:1], scores[1:])
    assert look.detections.masks == both.masks[:1]
    assert look.faint.masks == both.masks[1:]


def test_frames_looked_back_at_get_the_poses_that_the_map_gives_them(config: Config) -> None:
    """An odometry at half the map's size, turned and moved: poses of both are exact."""
    chooser = Chooser(config, CAMERA)
    S_map_odom = Sim3(2.0, so3.exp(np.array([0.1, -0.2, 0.3])), np.array([1.0, 2.0, 3.0]))
    T_odom = [se3.exp(np.array([0.1 * i, 0.0, 0.05 * i, 0.0, 0.02 * i, 0.0])) for i in range(3)]
    T_map = [sim3.transform_pose(S_map_odom, T) for T in T_odom]
    for i in range(2):
        lost = OdometryUpdate(i, i * PERIOD_NS, OdometryState.LOST, 1)
        assert chooser.choose(frame(i), FrameReport(lost, None, (), Timing())) is not None
    none = np.empty(0, np.float32)
    keyframe = KeyframeResult(
        frame(2), T_odom[2], DepthSamples(np.empty((0, 2), np.float32), none, none), (), None,
        followed=tuple(KeyframePose(i, T_odom[i], i * PERIOD_NS) for i in range(2)),
    )  # fmt: skip
    update = OdometryUpdate(
        2, 2 * PERIOD_NS, OdometryState.TRACKING, 1, T_odom[2], keyframe=keyframe
    )
    pose = MapPose(2, 2 * PERIOD_NS, T_map[2], T_map[2], 1e-4 * np.eye(6), 2.0, 0)

    sight = chooser.choose(frame(2), FrameReport(update, pose, (), Timing()))

    assert sight is not None
    assert sight.placed.keys() == {0, 1}
    for i in range(2):
        np.testing.assert_allclose(sight.placed[i], T_map[i], atol=1e-12)


def test_frames_are_chosen_by_time_and_by_how_sure_their_pose_is(config: Config) -> None:
    chooser = Chooser(config, CAMERA)

    unsure = chooser.choose(frame(0), report(0, sigma_m=0.5))  # what moves is seen all the same
    assert unsure is not None
    assert unsure.T_map_cam is None
    without = msgspec.structs.replace(config.segmenter, moving=())
    chooser = Chooser(msgspec.structs.replace(config, segmenter=without), CAMERA)
    assert chooser.choose(frame(0), report(0, sigma_m=0.5)) is None
    assert chooser.choose(frame(0), report(0)) is not None
    assert chooser.choose(Frame(1, PERIOD_NS // 2, frame(0).image), report(0)) is None
    assert chooser.choose(frame(1), report(1)) is not None
