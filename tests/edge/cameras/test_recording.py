# SPDX-License-Identifier: Apache-2.0
from pathlib import Path

import numpy as np
import pytest

from edge.cameras.base import Camera
from edge.cameras.recording import open_recording
from edge.errors import RecordingError
from tests.edge.cameras.recordings import picture, write_euroc, write_image, write_kitti, write_tum


def played(camera: Camera) -> list[int]:
    return [frame.index for frame in camera]


def test_frames_come_in_order_grey_raw_and_read_only(tmp_path: Path) -> None:
    frames = list(open_recording(write_tum(tmp_path)))

    assert [frame.index for frame in frames] == list(range(6))
    assert [frame.t_ns for frame in frames] == [50_000_000 * i for i in range(6)]
    for frame in frames:
        assert np.array_equal(frame.image, picture(frame.index))
        assert not frame.image.flags.writeable


@pytest.mark.parametrize(
    ("frames", "stride", "reverse", "expected"),
    [
        (None, 1, False, [0, 1, 2, 3, 4, 5]),
        (slice(1, 5), 1, False, [1, 2, 3, 4]),
        (slice(1, 5), 3, False, [1, 4]),
        (slice(0, 6), 4, True, [4, 0]),  # not [5, 1]: the stride counts from the slice's start
        (slice(1, None), 2, True, [5, 3, 1]),
        (slice(4, 99), 1, False, [4, 5]),
    ],
)
def test_slice_then_stride_then_reverse(
    tmp_path: Path, frames: slice | None, stride: int, reverse: bool, expected: list[int]
) -> None:
    recording = open_recording(write_tum(tmp_path), frames=frames, stride=stride, reverse=reverse)

    assert played(recording) == expected
    assert len(recording) == len(expected)


def test_each_frame_keeps_its_own_time_in_reverse(tmp_path: Path) -> None:
    recording = open_recording(write_tum(tmp_path), reverse=True)

    assert all(recording.t_ns[frame.index] == frame.t_ns for frame in recording)


def test_a_recording_plays_as_often_as_asked(tmp_path: Path) -> None:
    recording = open_recording(write_tum(tmp_path))

    assert played(recording) == played(recording)


@pytest.mark.parametrize("frames", [slice(6, 9), slice(3, 3)])
def test_a_range_without_frames_is_refused(tmp_path: Path, frames: slice) -> None:
    with pytest.raises(RecordingError, match=rf"frames {frames.start}:{frames.stop}: .* 6 frames"):
        open_recording(write_tum(tmp_path), frames=frames)


def test_a_stride_of_zero_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="stride: 0"):
        open_recording(write_tum(tmp_path), stride=0)


def spoil_missing(path: Path) -> None:
    path.unlink()


def spoil_empty(path: Path) -> None:
    path.write_bytes(b"")


def spoil_cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-20])


def spoil_words(path: Path) -> None:
    path.write_text("no image")


def spoil_size(path: Path) -> None:
    write_image(path, picture(0, 48, 64))


@pytest.mark.parametrize(
    ("spoil", "word"),
    [
        (spoil_missing, "is missing"),
        (spoil_empty, "is empty"),
        (spoil_cut, "is cut short"),
        (spoil_words, "no image that can be decoded"),
        (spoil_size, "is 48x64, its camera is 64x48"),
    ],
)
def test_a_bad_image_is_skipped_with_one_line_and_counted(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, spoil, word: str
) -> None:
    recording = open_recording(write_tum(tmp_path))
    spoil(tmp_path / "rgb" / "002.png")

    assert played(recording) == [0, 1, 3, 4, 5]
    assert played(recording) == [0, 1, 3, 4, 5]
    assert recording.image(2) is None
    assert recording.dropped == 1
    (line,) = caplog.messages
    assert str(tmp_path / "rgb" / "002.png") in line
    assert word in line


def test_many_bad_images_have_few_lines(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    recording = open_recording(write_tum(tmp_path, 30))
    for i in range(1, 30):
        (tmp_path / "rgb" / f"{i:03d}.png").unlink()

    assert played(recording) == [0]
    assert recording.dropped == 29
    assert len(caplog.messages) == 11


def test_a_play_without_any_image_ends_with_an_error(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    recording = open_recording(write_tum(tmp_path), frames=slice(2, 4))
    spoil_cut(tmp_path / "rgb" / "002.png")
    spoil_size(tmp_path / "rgb" / "003.png")

    with pytest.raises(RecordingError, match=r"none of the 2 .*002\.png: is cut short"):
        played(recording)
    assert caplog.messages == []


def test_bad_images_before_the_first_good_one_have_their_lines(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    recording = open_recording(write_tum(tmp_path, 30))
    for i in (*range(12), 20):
        (tmp_path / "rgb" / f"{i:03d}.png").unlink()
    assert played(recording)[0] == 12
    assert len(caplog.messages) == 11
    assert all(f"{i:03d}.png" in line for i, line in enumerate(caplog.messages[:10]))


def test_bad_truth_does_not_stop_a_play(tmp_path: Path) -> None:
    write_tum(tmp_path)
    (tmp_path / "groundtruth.txt").write_text("0.0 1 2 3\n")
    recording = open_recording(tmp_path)

    assert len(played(recording)) == 6
    with pytest.raises(RecordingError, match=r"groundtruth\.txt line 1"):
        _ = recording.groundtruth


def test_a_recording_without_extras_says_none(tmp_path: Path) -> None:
    write_tum(tmp_path)
    (tmp_path / "groundtruth.txt").unlink()
    recording = open_recording(tmp_path)

    assert recording.groundtruth is None
    assert recording.depth(0) is None
    assert recording.right(0) is None
    assert recording.right_camera is None
    assert recording.T_left_right is None
    assert recording.lidar_file(0) is None
    assert not recording.has_depth


def test_each_format_is_known_by_its_folder(tmp_path: Path) -> None:
    assert len(open_recording(write_tum(tmp_path / "tum"))) == 6
    assert len(open_recording(write_euroc(tmp_path / "euroc"))) == 4
    assert len(open_recording(tmp_path / "euroc" / "mav0")) == 4
    assert len(open_recording(write_kitti(tmp_path / "kitti"))) == 3


def test_a_folder_that_is_no_recording_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"is no recording; expected rgb\.txt"):
        open_recording(tmp_path)
    with pytest.raises(RecordingError, match="does not exist"):
        open_recording(tmp_path / "missing")


def test_an_image_that_is_needed_says_why_it_cannot_be_had(tmp_path: Path) -> None:
    root = write_tum(tmp_path)
    assert open_recording(root).needed_image(0).flags.writeable is False
    write_image(root / "rgb" / "001.png", picture(1, 20, 30))
    with pytest.raises(RecordingError, match=r"001\.png: is 20x30, its camera is 64x48;.* 1$"):
        open_recording(root).needed_image(1)
