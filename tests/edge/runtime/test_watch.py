# SPDX-License-Identifier: Apache-2.0
"""The model of key colours looks at a grey wall, where the map knows a ball: it is gone."""

import time
from pathlib import Path

import msgspec
import numpy as np
import onnx
import pytest

from edge.config import Config
from edge.errors import ModelRefused
from edge.outputs.report import FrameReport, Timing
from edge.runtime.sights import Chooser
from edge.runtime.watch import LiveWatch, ReplayWatch
from edge.tiles.reader import Map
from edge.types import ChangeEvent, Frame, MapPose, OdometryState, OdometryUpdate
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
