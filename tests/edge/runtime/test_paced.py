# SPDX-License-Identifier: Apache-2.0
import itertools
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from edge.cameras.recording import open_recording
from edge.errors import CameraLost
from edge.runtime.paced import PacedRecording
from edge.types import Frame
from tests.edge.cameras.recordings import picture, write_tum

PERIOD_NS = 50_000_000


def shown(frames: list[Frame]) -> list[int]:
    """Which pictures they are."""
    return [
        next(i for i in range(10) if np.array_equal(frame.image, picture(i))) for frame in frames
    ]


def test_way_back_follows_the_way_forth(tmp_path: Path) -> None:
    camera = PacedRecording(open_recording(write_tum(tmp_path, 4)), "forth_and_back")
    frames = list(itertools.islice(camera, 10))
    assert shown(frames) == [0, 1, 2, 3, 2, 1, 0, 1, 2, 3]
    assert [frame.index for frame in frames] == list(range(10))


def test_frames_come_at_the_recorded_rate_with_the_time_at_which_they_come(tmp_path: Path) -> None:
    began_ns = time.monotonic_ns()
    frames = []
    for frame in PacedRecording(open_recording(write_tum(tmp_path, 9)), "once"):
        assert frame.t_ns <= time.monotonic_ns()
        frames.append(frame)
    steps = np.diff([frame.t_ns for frame in frames])
    assert len(frames) == 9
    assert frames[0].t_ns >= began_ns
    assert steps.min() == PERIOD_NS  # where reading was late, the clock went on without it


def test_again_begins_anew_an_interval_later(tmp_path: Path) -> None:
    camera = PacedRecording(open_recording(write_tum(tmp_path, 3)), "again")
    frames = list(itertools.islice(camera, 7))
    assert shown(frames) == [0, 1, 2, 0, 1, 2, 0]
    assert (np.diff([frame.t_ns for frame in frames]) > 0).all()


def test_single_frame_is_no_way_back(tmp_path: Path) -> None:
    camera = PacedRecording(open_recording(write_tum(tmp_path, 1)), "forth_and_back")
    assert len(list(camera)) == 1


def test_stop_is_heard_while_it_waits(tmp_path: Path) -> None:
    camera = PacedRecording(open_recording(write_tum(tmp_path, 3)), "again")
    frames = iter(camera)
    next(frames)
    threading.Timer(0.01, camera.stop).start()
    list(frames)  # else without end


def test_recording_without_images_is_lost_at_once(tmp_path: Path) -> None:
    root = write_tum(tmp_path, 2)
    for image in (root / "rgb").iterdir():
        image.write_bytes(b"")
    with pytest.raises(CameraLost, match="no image"):
        list(PacedRecording(open_recording(root), "once"))
