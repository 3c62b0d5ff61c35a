# SPDX-License-Identifier: Apache-2.0
import resource
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import msgspec
import numpy as np
import pytest

from edge.cameras.recording import open_recording
from edge.capture import format as format_
from edge.capture.reader import CaptureFile
from edge.capture.seal import is_sealed
from edge.config.recorder import RecorderConfig
from edge.errors import OutputError
from edge.outputs.capture_ring import CaptureRing
from edge.types import Frame
from tests.edge.capture.captures import header, picture, write
from tests.edge.outputs.reports import PERIOD_NS, report


def _config(folder: Path, **settings: object) -> RecorderConfig:
    chosen = {"folder": str(folder), "segment_s": 1.0, "min_free_mb": 0.0} | settings
    return msgspec.convert(chosen, RecorderConfig)


def _frame(index: int, seed: int | None = None) -> Frame:
    return Frame(index, index * PERIOD_NS, picture(index if seed is None else seed))


def _record(ring: CaptureRing, indices: range) -> None:
    for index in indices:
        ring.add_frame(_frame(index))
        ring.add_report(report(index))


def test_files_are_whole_and_together_one_recording(tmp_path: Path) -> None:
    ring = CaptureRing(_config(tmp_path), header("s"))
    _record(ring, range(75))
    ring.close()
    files = sorted(tmp_path.glob("*.mcap"))
    assert len(files) == 3
    assert all(is_sealed(path) for path in files)
    frames = list(open_recording(tmp_path))
    assert [frame.t_ns for frame in frames] == [index * PERIOD_NS for index in range(75)]
    np.testing.assert_array_equal(frames[40].image, picture(40))
    states = [list(CaptureFile(path).rows(format_.STATE)) for path in files]
    assert sum(map(len, states)) == 75


def test_a_file_that_cannot_be_read_keeps_nothing_from_being_recorded(tmp_path: Path) -> None:
    (tmp_path / "bad.mcap").symlink_to("nowhere")
    ring = CaptureRing(_config(tmp_path), header())
    _record(ring, range(3))
    assert ring.state == "recording"
    assert ring.keep("it") is not None
    ring.close()


def test_only_every_so_many_images_are_kept_but_all_states(tmp_path: Path) -> None:
    ring = CaptureRing(_config(tmp_path, image_stride=5, segment_s=60), header())
    _record(ring, range(30))
    ring.close()
    (path,) = tmp_path.glob("*.mcap")
    assert len(CaptureFile(path).image_places) == 6
    assert len(list(CaptureFile(path).rows(format_.FRAME))) == 30


def test_the_oldest_files_go(tmp_path: Path) -> None:
    ring = CaptureRing(_config(tmp_path, keep_mb=10.0), header())
    big = np.random.default_rng(0).integers(0, 256, (700, 1000), dtype=np.uint8)
    for index in range(31 * 8):
        if index % 10 == 0:
            ring.add_frame(Frame(index, index * PERIOD_NS, big))
    ring.close()
    files = sorted(tmp_path.glob("*.mcap"))
    assert sum(path.stat().st_size for path in files) <= 10e6
    assert files[-1].name.endswith("00006.mcap")
    assert len(files) >= 3


def test_a_file_never_holds_more_than_a_quarter_of_the_ring(tmp_path: Path) -> None:
    ring = CaptureRing(_config(tmp_path, keep_mb=10.0, segment_s=3600), header())
    big = np.random.default_rng(0).integers(0, 256, (700, 1000), dtype=np.uint8)
    for index in range(40):
        ring.add_frame(Frame(index, index * PERIOD_NS, big))
    ring.close()
    sizes = [path.stat().st_size for path in tmp_path.glob("*.mcap")]
    assert len(sizes) >= 2
    assert max(sizes) < 10e6 / 4 + 3e6  # one chunk more
    assert sum(sizes) <= 10e6


def test_times_that_go_back_begin_a_new_file(tmp_path: Path) -> None:
    ring = CaptureRing(_config(tmp_path, segment_s=10), header())
    _record(ring, range(200, 210))
    _record(ring, range(10))
    ring.close()
    first, second = sorted(tmp_path.glob("*.mcap"))
    assert CaptureFile(first).image_places[0].t_ns == 200 * PERIOD_NS
    assert CaptureFile(second).image_places[0].t_ns == 0


def test_what_is_kept_stays_whole_and_out_of_the_ring(tmp_path: Path) -> None:
    ring = CaptureRing(_config(tmp_path), header("s"))
    _record(ring, range(75))
    folder = ring.keep("lost: at the door/../x")
    _record(ring, range(75, 80))
    ring.close()
    assert folder is not None
    assert folder.parent == tmp_path / "kept"
    assert [frame.t_ns // PERIOD_NS for frame in open_recording(folder)] == list(range(31, 75))
    assert len(list(tmp_path.glob("*.mcap"))) == 2


def test_a_second_process_is_kept_out(tmp_path: Path) -> None:
    ring = CaptureRing(_config(tmp_path), header())
    with pytest.raises(OutputError, match="another mapvo records there"):
        CaptureRing(_config(tmp_path), header())
    ring.close()
    CaptureRing(_config(tmp_path), header()).close()


def test_what_an_earlier_process_left_is_mended(tmp_path: Path) -> None:
    path = write(tmp_path / "old.mcap", 25, finish=False)
    CaptureRing(_config(tmp_path), header()).close()
    assert len(CaptureFile(path).image_places) == 21


def test_too_little_room_is_waited_out(tmp_path: Path) -> None:
    room = [0]
    config = _config(tmp_path, min_free_mb=100.0)
    ring = CaptureRing(config, header(), free_bytes=lambda _: room[0])
    _record(ring, range(10))
    assert ring.state == "full"
    assert not list(tmp_path.glob("*.mcap"))
    room[0] = 200_000_000
    _record(ring, range(10, 20))  # tried again after a while only
    assert ring.state == "full"
    _record(ring, range(200, 210))
    assert ring.state == "recording"
    ring.close()
    assert len(list(open_recording(tmp_path))) == 10


@contextmanager
def _small_files(size: int) -> Iterator[None]:
    """Writing beyond `size` fails, as on a full disk."""
    usual = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, usual[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, usual)
        signal.signal(signal.SIGXFSZ, handler)


def test_a_full_disk_costs_neither_what_was_written_nor_the_caller(tmp_path: Path) -> None:
    ring = CaptureRing(_config(tmp_path, segment_s=60), header("s"))
    with _small_files(200_000):
        _record(ring, range(100))
    assert ring.state == "full"
    _record(ring, range(400, 410))
    assert ring.state == "recording"
    ring.close()
    played = [frame.t_ns // PERIOD_NS for frame in open_recording(tmp_path)]
    assert played[:30] == list(range(30))
    assert played[-10:] == list(range(400, 410))


def test_a_disk_that_was_full_at_the_first_byte_is_tried_again(tmp_path: Path) -> None:
    ring = CaptureRing(_config(tmp_path, segment_s=60), header("s"))
    with _small_files(100):
        _record(ring, range(10))
    assert ring.state == "full"
    assert not list(tmp_path.glob("*.mcap"))
    _record(ring, range(400, 410))
    assert ring.state == "recording"
    ring.close()
    assert len(list(open_recording(tmp_path))) == 10


def test_a_folder_that_cannot_be_made_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(OutputError, match=r"recorder\.folder .*file/x: .*name a folder"):
        CaptureRing(_config(tmp_path / "file" / "x"), header())
