# SPDX-License-Identifier: Apache-2.0
from pathlib import Path

import msgspec
import numpy as np

from edge.cameras.recording import open_recording
from edge.capture import format as format_
from edge.capture.reader import CaptureFile
from edge.config.recorder import RecorderConfig
from edge.runtime.recorder import Recorder
from edge.types import Frame
from tests.edge.capture.captures import header, picture
from tests.edge.outputs.reports import PERIOD_NS, report


def test_all_that_was_given_is_in_the_file_after_closing(tmp_path: Path) -> None:
    config = msgspec.convert({"folder": str(tmp_path), "min_free_mb": 0.0}, RecorderConfig)
    recorder = Recorder(config, header())
    for index in range(40):
        recorder.image(Frame(index, index * PERIOD_NS, picture(index)))
        recorder.write(report(index))
    recorder.keep("test")
    recorder.close()
    assert (recorder.state, recorder.dropped) == ("recording", 0)
    (path,) = tmp_path.glob("kept/*/*.mcap")
    frames = list(open_recording(path))
    assert len(frames) == 40
    np.testing.assert_array_equal(frames[9].image, picture(9))
    assert len(list(CaptureFile(path).rows(format_.POSE))) == 40


def test_a_disk_that_stands_still_loses_the_oldest_and_nobody_waits(tmp_path: Path) -> None:
    one_file = {"folder": str(tmp_path), "min_free_mb": 0.0, "segment_s": 3600}
    config = msgspec.convert(one_file, RecorderConfig)
    recorder = Recorder(config, header())
    image = np.zeros((48, 64), np.uint8)
    for index in range(2000):  # faster than any disk
        recorder.image(Frame(index, index * PERIOD_NS, image))
    recorder.close()
    (path,) = tmp_path.glob("*.mcap")
    kept = [frame.t_ns // PERIOD_NS for frame in open_recording(tmp_path)]
    assert len(CaptureFile(path).image_places) + recorder.dropped == 2000
    assert kept[-1] == 1999
