# SPDX-License-Identifier: Apache-2.0
import os
import signal
import sys
from collections.abc import Iterator
from pathlib import Path

import msgspec
import numpy as np
import pytest

from edge.config.segmenter import SegmenterConfig
from edge.segmenter.process import Segmentation, SegmenterProcess
from tests.edge.segmenter.graphs import THINGS, write_graph, write_moody

SHAPE = (64, 64, 3)
CALM = np.full(SHAPE, 100, np.uint8)
CONFIG = SegmenterConfig(memory_mb=600)
HOUR_NS = 3_600_000_000_000


class Clock:
    """Stands still unless it is told to go on: a slow machine is never too slow."""

    def __init__(self) -> None:
        self.now_ns = 0

    def __call__(self) -> int:
        return self.now_ns


def coloured(channel: int) -> np.ndarray:
    image = np.zeros(SHAPE, np.uint8)
    image[:, :, channel] = 255
    return image


def wait(process: SegmenterProcess, *states: str) -> Segmentation | None:
    """Poll until the state is one of these."""
    for _ in range(300):
        found = process.poll(1.0)
        if process.status.state in states:
            return found
    raise AssertionError(f"still {process.status}")


@pytest.fixture(scope="module")
def moody(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_moody(tmp_path_factory.mktemp("model") / "moody.onnx")


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def process(moody: Path, clock: Clock) -> Iterator[SegmenterProcess]:
    process = SegmenterProcess(moody, SHAPE, CONFIG, clock=clock)
    yield process
    process.close()


def segment(process: SegmenterProcess, mark: int, image: np.ndarray) -> Segmentation | None:
    assert process.offer(mark, image)
    assert not process.offer(mark + 1, image)  # one at a time
    return wait(process, "ready", "waiting")


@pytest.mark.slow
def test_nan_and_hunger_for_memory_are_said_and_the_next_image_is_seen(
    process: SegmenterProcess, clock: Clock
) -> None:
    assert not process.offer(0, CALM)  # it has not opened yet
    wait(process, "ready")
    assert process.contract is not None
    assert process.contract.output.convention == "yolov8"

    seen = segment(process, 1, CALM)
    assert seen is not None
    assert seen.mark == 1
    assert len(seen.detections.masks) == len(THINGS)

    assert segment(process, 2, coloured(0)) is None
    assert "output0 holds NaN" in process.status.reason
    assert process.status.restarts == 0

    assert segment(process, 3, coloured(2)) is None
    assert process.status.failed == 2
    assert process.status.reason
    clock.now_ns += HOUR_NS  # in case it died of it
    wait(process, "ready")

    assert segment(process, 4, CALM) is not None
    assert process.status.reason == ""
    assert process.status.images == 2
    assert 0 < process.status.rss_mb < CONFIG.memory_mb


@pytest.mark.slow
def test_a_hanging_and_a_killed_process_are_started_anew_after_a_wait(
    process: SegmenterProcess, clock: Clock
) -> None:
    wait(process, "ready")
    assert process.offer(1, coloured(1))
    assert process.poll(0.0) is None
    clock.now_ns += HOUR_NS

    wait(process, "waiting")
    assert "did not answer in time" in process.status.reason
    first = process.status.pid
    assert first == 0
    process.poll()
    assert process.status.state == "waiting"  # not before its time
    clock.now_ns += round(CONFIG.first_wait_s * 1e9)
    wait(process, "ready")
    assert segment(process, 2, CALM) is not None

    os.kill(process.status.pid, signal.SIGKILL)
    wait(process, "waiting")
    assert "ended by signal 9" in process.status.reason
    assert process.status.restarts == 2
    clock.now_ns += round(CONFIG.first_wait_s * 1e9)
    process.poll()
    assert process.status.state == "waiting"  # the second wait is longer
    clock.now_ns += round(CONFIG.first_wait_s * 1e9)
    wait(process, "ready")
    assert segment(process, 3, CALM) is not None


@pytest.mark.slow
def test_a_model_that_cannot_be_used_is_not_tried_again(tmp_path: Path, clock: Clock) -> None:
    path = write_graph(tmp_path / "boxes.onnx", {"output0": np.zeros((1, 15, 84), np.float32)})
    process = SegmenterProcess(path, SHAPE, CONFIG, clock=clock)

    wait(process, "refused")
    clock.now_ns += HOUR_NS
    process.poll()

    assert process.status.state == "refused"
    assert "it finds boxes only" in process.status.reason
    process.close()


def test_cores_that_are_not_there_are_refused(moody: Path, clock: Clock) -> None:
    config = msgspec.structs.replace(CONFIG, cpus=(1023,))
    process = SegmenterProcess(moody, SHAPE, config, clock=clock)

    wait(process, "refused")

    assert "segmenter.cpus = [1023]" in process.status.reason
    process.close()


@pytest.mark.parametrize(
    ("script", "said"),
    [
        ("raise SystemExit(7)", "ended (status 7)"),
        ("import os; os.write(int(FD), b'\\xff' * 50); import time; time.sleep(999)", "nonsense"),
        ("import os; os.write(int(FD), b'\\x02\\0\\0\\0xx'); os.abort()", "nonsense"),
    ],
)
def test_a_process_that_misbehaves_is_ended(
    script: str, said: str, tmp_path: Path, clock: Clock
) -> None:
    prelude = "import json, sys; FD = json.loads(sys.argv[1])['answers_fd']; "
    child = (sys.executable, "-c", prelude + script)
    process = SegmenterProcess(tmp_path / "none", SHAPE, CONFIG, child=child, clock=clock)

    wait(process, "waiting")

    assert said in process.status.reason
    assert process.status.restarts == 1
    process.close()


def test_a_process_that_cannot_be_started_waits(tmp_path: Path, clock: Clock) -> None:
    process = SegmenterProcess(
        tmp_path / "none", SHAPE, CONFIG, child=(str(tmp_path / "no"),), clock=clock
    )

    assert process.status.state == "waiting"
    assert "could not be started: No such file" in process.status.reason
    process.close()
