# SPDX-License-Identifier: Apache-2.0
"""Whatever a model does, each frame has its pose, and the status says what is wrong."""

import dataclasses
import os
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import msgspec
import numpy as np
import pytest

from edge.config import Config
from edge.geometry.camera import CameraModel
from edge.outputs.report import FrameReport
from edge.runtime.pipeline import Pipeline
from edge.runtime.stages import replay_pipeline
from edge.runtime.synthetic import WallDrive
from edge.runtime.watch import LiveWatch
from edge.types import U8, Frame, OdometryState
from tests.edge.segmenter.graphs import CLASSES, write_moody, write_sidecar

pytestmark = pytest.mark.slow

CAMERA = CameraModel(320, 240, 280.0, 280.0, 159.5, 119.5)
CALM, NAN, HANG, HUNGER = (100, 100, 100), (255, 0, 0), (0, 255, 0), (0, 0, 255)
START_FRAMES, FRAMES = 20, 6  # until the odometry tracks; with each trouble
SETTINGS = {"memory_mb": 600, "image_timeout_s": 600.0, "first_wait_s": 0.0}


class Run:
    """The tracking thread's loop: each frame through the pipeline, then to the watch."""

    def __init__(self, pipeline: Pipeline, watch: LiveWatch, frames: Iterator[Frame]) -> None:
        self._pipeline, self._watch, self._frames = pipeline, watch, frames

    def show(self, colour: tuple[int, int, int], n: int = FRAMES) -> list[FrameReport]:
        """Track `n` frames while the model gets images of that colour."""
        image: U8 = np.full((CAMERA.height, CAMERA.width, 3), colour, np.uint8)
        reports = []
        for _ in range(n):
            frame = dataclasses.replace(next(self._frames), colour=lambda: image)
            report = self._pipeline.step(frame)
            self._watch.step(frame, report)
            self._watch.moving()
            reports.append(report)
        return reports

    def kill(self) -> None:
        """End the model's process from outside."""
        process = self._watch._watcher.process
        assert process is not None
        os.kill(process.status.pid, signal.SIGKILL)

    def wait(self, holds: Callable[[str], bool]) -> str:
        """Let time pass, without frames, until the status is so."""
        for _ in range(60_000):
            if holds(self._watch.state):
                return self._watch.state
            time.sleep(0.001)
        raise AssertionError(f"still {self._watch.state}")


def are_tracked(reports: list[FrameReport]) -> bool:
    return all(
        report.update.state == OdometryState.TRACKING and report.update.T_odom_cam is not None
        for report in reports
    )


@pytest.fixture
def run(tmp_path: Path) -> Iterator[Run]:
    model = write_moody(tmp_path / "moody.onnx")
    write_sidecar(model, 'fit = "stretch"')  # no padding: its moods are of means
    segmenter = msgspec.structs.replace(
        Config().segmenter, model=str(model), moving=CLASSES, **SETTINGS
    )
    changes = msgspec.structs.replace(Config().changes, interval_s=0.0)
    config = msgspec.structs.replace(Config(), segmenter=segmenter, changes=changes)
    watch = LiveWatch(config, CAMERA, None)
    frames = iter(WallDrive(START_FRAMES + 6 * FRAMES, CAMERA))
    try:
        with replay_pipeline(Config(), CAMERA, None) as pipeline:
            run = Run(pipeline, watch, frames)
            run.wait(lambda state: state == "ready")
            run.show(CALM, START_FRAMES)
            run.wait(lambda state: state == "ready")
            yield run
    finally:
        watch.close()


def test_poses_go_on_with_a_model_that_gives_nan_eats_memory_hangs_and_is_killed(run: Run) -> None:
    assert are_tracked(run.show(NAN))
    run.wait(lambda state: "output0 holds NaN" in state)

    assert are_tracked(run.show(HUNGER))
    run.wait(lambda state: ":" in state and "NaN" not in state)  # why, or why it has ended
    run.wait(lambda state: state.startswith("ready"))

    assert are_tracked(run.show(HANG))
    run.wait(lambda state: state.startswith("busy"))
    assert are_tracked(run.show(HANG))
    run.kill()
    run.wait(lambda state: "ended by signal 9" in state)  # it is soon "ready" again
    assert are_tracked(run.show(CALM))
    run.wait(lambda state: state.startswith("ready"))

    assert are_tracked(run.show(CALM))
    run.wait(lambda state: state == "ready")
