# SPDX-License-Identifier: Apache-2.0
import logging
from pathlib import Path

import numpy as np
import pytest

from edge.cameras.recording import open_recording
from edge.capture.seal import seal
from edge.errors import EdgeError, RecordingError
from tests.edge.capture.captures import CAMERA, PERIOD_NS, header, picture, write


@pytest.mark.parametrize("images", ["png", "raw"])
def test_a_file_plays_as_it_was_recorded(tmp_path: Path, images: str) -> None:
    recording = open_recording(write(tmp_path / "a.mcap", images=images))  # type: ignore[arg-type]
    assert recording.camera == CAMERA
    assert recording.rate_hz == 10.0
    frames = list(recording)
    assert [frame.index for frame in frames] == list(range(25))
    for frame in frames:
        assert frame.t_ns == frame.index * PERIOD_NS
        np.testing.assert_array_equal(frame.image, picture(frame.index))


def test_a_file_that_was_replaced_is_read_anew(tmp_path: Path) -> None:
    path = write(tmp_path / "a.mcap", images="raw")
    assert len(list(open_recording(path))) == 25
    path.unlink()
    frames = list(open_recording(write(path, first=100)))
    np.testing.assert_array_equal(frames[0].image, picture(100))


def test_slice_stride_and_reverse_apply(tmp_path: Path) -> None:
    path = write(tmp_path / "a.mcap")
    frames = list(open_recording(path, frames=slice(4, 20), stride=5, reverse=True))
    assert [frame.index for frame in frames] == [19, 14, 9, 4]
    np.testing.assert_array_equal(frames[1].image, picture(14))


def test_a_session_in_several_files_is_one_recording(tmp_path: Path) -> None:
    for segment, name in enumerate("ba"):  # names say nothing
        write(tmp_path / f"{name}.mcap", 7, first=7 * segment, made=header("s", segment))
    frames = list(open_recording(tmp_path))
    assert [frame.t_ns // PERIOD_NS for frame in frames] == list(range(14))
    np.testing.assert_array_equal(frames[9].image, picture(9))


def test_files_of_two_sessions_are_not_mixed(tmp_path: Path) -> None:
    write(tmp_path / "a.mcap", made=header("one"))
    write(tmp_path / "b.mcap", made=header("two"))
    with pytest.raises(RecordingError, match=r"several recordings: name one file, a\.mcap or b"):
        open_recording(tmp_path)


def test_a_clock_set_back_leaves_frames_out(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    write(tmp_path / "a.mcap", 7, made=header("s", 0))
    write(tmp_path / "b.mcap", 7, first=3, made=header("s", 1))
    with caplog.at_level(logging.WARNING):
        frames = list(open_recording(tmp_path))
    assert [frame.t_ns // PERIOD_NS for frame in frames] == list(range(10))
    assert "left_out=4" in caplog.text


def test_a_file_cut_off_says_how_to_mend_it(tmp_path: Path) -> None:
    path = write(tmp_path / "a.mcap", finish=False)
    with pytest.raises(RecordingError, match=r"a\.mcap: was cut off: .*mapvo recover"):
        open_recording(path)


def test_a_damaged_image_is_left_out_and_counted(tmp_path: Path) -> None:
    path = write(tmp_path / "a.mcap", 25)
    data = bytearray(path.read_bytes())
    data[data.index(b"\x89PNG") + 50] ^= 0xFF  # its chunk's checksum no longer holds
    path.write_bytes(data)
    recording = open_recording(path)
    assert [frame.index for frame in recording] == list(range(11, 25))
    assert recording.dropped == 11


def _damage(whole: bytes, rng: np.random.Generator) -> bytes:
    """One to five wounds, half of them where lengths and places stand."""
    data = bytearray(whole)
    ends = np.r_[0:900, len(whole) - 1500 : len(whole)]
    for _ in range(int(rng.integers(1, 6))):
        at = int(rng.choice(ends)) if rng.random() < 0.5 else int(rng.integers(len(data)))
        wounds = (bytes([int(rng.integers(256))]), rng.bytes(8), b"\xff" * 8, b"")
        wound = wounds[int(rng.integers(4))]
        data[at : at + (len(wound) or int(rng.integers(1, 300)))] = wound
    return bytes(data)


def test_damaged_files_are_refused_in_one_line_or_played(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.CRITICAL)
    whole = write(tmp_path / "w.mcap", 12, images="raw").read_bytes()
    rng = np.random.default_rng(1)
    refused = 0
    for number in range(300):
        path = tmp_path / f"{number}.mcap"
        path.write_bytes(_damage(whole, rng))
        for use in (lambda p: list(open_recording(p)), seal):
            try:
                use(path)
            except EdgeError as error:
                refused += 1
                assert str(error).startswith(str(path))  # noqa: PT017  # both ends are right
                assert "\n" not in str(error)  # noqa: PT017
        path.unlink()
    assert 50 < refused < 550
