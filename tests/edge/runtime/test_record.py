# SPDX-License-Identifier: Apache-2.0
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from edge.cameras.recording import open_recording
from edge.capture.reader import CaptureFile
from edge.cli import main
from edge.errors import OutputError
from edge.runtime.record import Fetched, Limits, Played, record
from edge.types import Frame
from tests.edge.cameras.recordings import write_tum
from tests.edge.capture.captures import header, picture, write
from tests.edge.outputs.reports import PERIOD_NS

ROOMY = Limits(min_free_mb=0.0)


class ListCamera:
    """A live camera that gives frames until it is stopped."""

    def __init__(self, count: int) -> None:
        self.dropped = 0
        self.closed = False
        self._count = count
        self._stopped = threading.Event()

    def __iter__(self) -> Iterator[Frame]:
        for index in range(self._count):
            yield Frame(index, index * PERIOD_NS, picture(index))
        self._stopped.wait(10.0)

    def stop(self) -> None:
        self._stopped.set()

    def close(self) -> None:
        self.closed = True


def test_a_live_camera_is_recorded_until_the_limit_and_freed(tmp_path: Path) -> None:
    camera = ListCamera(50)
    out = tmp_path / "new" / "a.mcap"
    done = record(Fetched(camera), out, header(), "png", ROOMY._replace(frames=50))
    assert (done.frames, done.dropped, done.full) == (50, 0, False)
    assert camera.closed
    frames = list(open_recording(out))
    np.testing.assert_array_equal(frames[49].image, picture(49))


def test_seconds_count_by_the_frames_own_time(tmp_path: Path) -> None:
    limits = ROOMY._replace(seconds=1.0)
    done = record(Fetched(ListCamera(60)), tmp_path / "a.mcap", header(), "raw", limits)
    assert done.frames == 31  # 0 s to 0.99999999 s


def test_it_ends_while_the_disk_has_room_for_others(tmp_path: Path) -> None:
    limits = Limits(min_free_mb=1e9)
    done = record(Fetched(ListCamera(5)), tmp_path / "a.mcap", header(), "png", limits)
    assert (done.frames, done.full) == (0, True)


def test_an_earlier_recording_is_not_overwritten(tmp_path: Path) -> None:
    path = write(tmp_path / "a.mcap")
    before = path.read_bytes()
    with pytest.raises(OutputError, match=r"a\.mcap: exists"):
        record(Fetched(ListCamera(5)), path, header(), "png", ROOMY)
    assert path.read_bytes() == before


def test_a_place_that_cannot_be_is_not_said_to_exist(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(OutputError, match=r"file/a\.mcap: cannot be written"):
        record(Fetched(ListCamera(5)), tmp_path / "file" / "a.mcap", header(), "png", ROOMY)


def test_a_recording_is_converted_by_the_command(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source = write_tum(tmp_path / "source", 6)
    out = tmp_path / "a.mcap"
    assert main(["record", str(source), "--frames", "1:", "--stride", "2", "--out", str(out)]) == 0
    assert "3 frames, 0 dropped" in capsys.readouterr().out
    expected = list(open_recording(source, frames=slice(1, None), stride=2))
    converted = open_recording(out)
    assert converted.camera == open_recording(source).camera
    for before, after in zip(expected, converted, strict=True):
        assert before.t_ns == after.t_ns
        np.testing.assert_array_equal(before.image, after.image)
    assert '"folder"' in CaptureFile(out).header.info["settings"]


def test_a_disk_without_room_is_refused_and_nothing_left_on_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "a.toml").write_text("[recorder]\nmin_free_mb = 1e9\n")
    source = write_tum(tmp_path / "drive")
    out = tmp_path / "a.mcap"
    command = ["record", str(source), "--config", str(tmp_path / "a.toml"), "--out", str(out)]
    assert main(command) == 2
    assert "recorder.min_free_mb" in capsys.readouterr().err
    assert not out.exists()


def test_recover_mends_each_file_and_fails_for_what_is_none(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cut = write(tmp_path / "cut.mcap", finish=False)
    (tmp_path / "no.mcap").write_text("no")
    whole = write(tmp_path / "whole.mcap")
    files = [str(tmp_path / "no.mcap"), str(cut), str(whole)]
    assert main(["recover", *files]) == 2
    printed = capsys.readouterr()
    assert "cut.mcap: mended, 41 messages" in printed.out
    assert "whole.mcap: whole already, 50 messages" in printed.out
    assert "no.mcap: is no recording file" in printed.err
    assert len(list(Played(open_recording(cut)))) == 21
