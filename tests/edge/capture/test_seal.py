# SPDX-License-Identifier: Apache-2.0
import resource
import signal
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from mcap.reader import make_reader

from edge.capture import format as format_
from edge.capture.reader import CaptureFile, StoredImage
from edge.capture.seal import is_sealed, seal
from edge.errors import RecordingError
from tests.edge.capture.captures import PERIOD_NS, picture, write


def _numbers(path: Path) -> list[int]:
    """Images of the file that come back whole, by their numbers."""
    capture = CaptureFile(path)
    found = []
    for place in capture.image_places:
        data = StoredImage(path, place.chunk, place.offset, 0).read_bytes()
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE)
        number = place.t_ns // PERIOD_NS
        np.testing.assert_array_equal(image, picture(number))
        found.append(number)
    return found


@pytest.mark.parametrize("images", ["png", "raw"])
def test_a_finished_file_is_left_as_it_is(tmp_path: Path, images: str) -> None:
    path = write(tmp_path / "a.mcap", images=images)  # type: ignore[arg-type]
    before = path.read_bytes()
    sealed = seal(path)
    assert sealed.was_whole
    assert sealed.messages == 50
    assert path.read_bytes() == before
    assert _numbers(path) == list(range(25))


def test_a_killed_recording_keeps_all_but_its_last_second(tmp_path: Path) -> None:
    path = write(tmp_path / "a.mcap", 25, finish=False)
    with pytest.raises(RecordingError, match="mapvo recover"):
        CaptureFile(path)
    sealed = seal(path)
    assert not sealed.was_whole
    assert _numbers(path) == list(range(21))  # a chunk each second
    assert [row for _, row in CaptureFile(path).rows(format_.STATE)][-1] == b'{"n": 19}'


def _lengths(size: int) -> Iterator[int]:
    """Every length near the records' ends, and some between."""
    yield from range(8, size, 997)
    yield from range(size - 60, size, 7)


def test_wherever_it_is_cut_it_is_mended_or_refused(tmp_path: Path) -> None:
    whole = write(tmp_path / "whole.mcap", 12).read_bytes()
    path = tmp_path / "cut.mcap"
    best = -1
    for length in _lengths(len(whole)):
        path.write_bytes(whole[:length])
        try:
            seal(path)
        except RecordingError as error:
            assert "holds nothing whole" in str(error)  # noqa: PT017  # both ends are right
            assert best < 0
            continue
        assert is_sealed(path)
        with path.open("rb") as file:  # the library takes it, checksums and all
            count = sum(1 for _ in make_reader(file, validate_crcs=True).iter_messages())
        capture = CaptureFile(path)  # which goes by the indexes alone
        assert len(capture.image_places) + len(list(capture.rows(format_.STATE))) == count
        assert count >= best
        best = max(best, count)
        again = path.read_bytes()
        assert seal(path).was_whole
        assert path.read_bytes() == again
    assert best == 24


def test_zeros_of_a_power_cut_are_cut_off(tmp_path: Path) -> None:
    path = write(tmp_path / "a.mcap", 25, finish=False)
    size = path.stat().st_size
    with path.open("ab") as file:
        file.write(bytes(10_000))
    assert seal(path).cut_bytes == 10_000
    assert path.stat().st_size < size + 10_000
    assert len(_numbers(path)) == 21


def test_a_damaged_chunk_is_left_out(tmp_path: Path) -> None:
    path = write(tmp_path / "a.mcap", 25, finish=False)
    data = bytearray(path.read_bytes())
    middle = data.index(b"\x89PNG", len(data) // 2) + 40
    data[middle] ^= 0xFF
    path.write_bytes(data)
    sealed = seal(path)
    assert sealed.bad_chunks == 1
    assert _numbers(path) == list(range(11))


def test_what_is_no_recording_is_refused_untouched(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    path.write_bytes(b"no recording at all")
    with pytest.raises(RecordingError, match="no recording file"):
        seal(path)
    assert path.read_bytes() == b"no recording at all"


def test_a_full_disk_leaves_a_file_that_can_be_mended(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    usual = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (60_000, usual[1]))
    try:
        with pytest.raises(OSError, match="too large"):
            write(path, 60)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, usual)
        signal.signal(signal.SIGXFSZ, handler)
    assert seal(path).messages > 20
    assert _numbers(path)[:11] == list(range(11))
