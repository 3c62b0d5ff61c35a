# SPDX-License-Identifier: Apache-2.0
from pathlib import Path

import numpy as np
import pytest

from edge.cameras.recording import open_recording
from edge.errors import RecordingError
from edge.geometry import se3
from tests.edge.cameras.recordings import picture, write_kitti


def test_frames_times_and_camera_are_read(tmp_path: Path) -> None:
    recording = open_recording(write_kitti(tmp_path))
    frames = list(recording)

    assert [frame.t_ns for frame in frames] == [0, 100_000_000, 200_000_000]
    assert np.array_equal(frames[1].image, picture(1))
    assert recording.camera.pinhole == (64, 48, 50.0, 50.0, 31.5, 23.5)
    assert recording.rate_hz == pytest.approx(10.0)


def test_the_right_camera_lies_a_baseline_to_the_right(tmp_path: Path) -> None:
    recording = open_recording(write_kitti(tmp_path))

    assert recording.T_left_right[:3, 3] == pytest.approx([0.54, 0.0, 0.0])
    assert np.array_equal(recording.right(2), picture(3))


def test_poses_are_those_of_the_left_grey_camera(tmp_path: Path) -> None:
    truth = open_recording(write_kitti(tmp_path)).groundtruth

    assert truth is not None
    assert truth.T_world_cam[:, :3, 3] == pytest.approx(np.array([[0, 0, 0], [0, 0, 1], [0, 0, 2]]))


def test_poses_of_the_colour_camera_are_moved_there(tmp_path: Path) -> None:
    recording = open_recording(write_kitti(tmp_path, pair=(2, 3)))

    assert recording.groundtruth is not None
    assert recording.groundtruth.T_world_cam[2, :3, 3] == pytest.approx([-0.06, 0.0, 2.0])
    assert recording.T_left_right[:3, 3] == pytest.approx([0.54, 0.0, 0.0])


def test_scans_are_listed_and_the_scanner_placed(tmp_path: Path) -> None:
    root = write_kitti(tmp_path)
    (root / "velodyne").mkdir()
    (root / "velodyne" / "000001.bin").write_bytes(b"")
    recording = open_recording(root)

    assert recording.lidar_file(0) is None
    assert recording.lidar_file(1) == root / "velodyne" / "000001.bin"
    forward = se3.transform(recording.T_cam_lidar, np.array([[5.0, 0.0, 0.0]]))
    assert forward == pytest.approx(np.array([[0.1, 0.2, 5.3]]))


def test_sequences_without_poses_have_no_truth(tmp_path: Path) -> None:
    root = write_kitti(tmp_path)
    (tmp_path / "poses" / "07.txt").unlink()

    assert open_recording(root).groundtruth is None


def test_the_size_is_that_of_the_first_image_that_can_be_read(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    root = write_kitti(tmp_path)
    (root / "image_0" / "000000.png").write_bytes(b"")
    recording = open_recording(root)

    assert [frame.index for frame in recording] == [1, 2]
    assert recording.dropped == 1
    assert "000000.png: is empty" in caplog.text


def test_poses_of_another_length_are_refused(tmp_path: Path) -> None:
    root = write_kitti(tmp_path)
    (tmp_path / "poses" / "07.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n")

    with pytest.raises(RecordingError, match=r"07\.txt: has 1 poses, times\.txt has 3"):
        _ = open_recording(root).groundtruth


@pytest.mark.parametrize(
    ("name", "text", "word"),
    [
        ("times.txt", None, r"times\.txt: is missing"),
        ("times.txt", "", r"times\.txt: holds no time"),
        ("times.txt", "0.0\n0.0\n", "line 2: time is not after"),
        ("calib.txt", None, r"calib\.txt: is missing"),
        ("calib.txt", "P1: 1 2 3\n", "line 1: has 4 columns, 13"),
        ("calib.txt", "P1: 50 0 31 0 0 50 23 0 0 0 1 0\n", "line 'P0:' is missing"),
        ("calib.txt", "P0: 50 0 31 0 0 50 23 0 0 0 0 0\n", "P0: is no projection"),
        ("calib.txt", "P0: 0 0 31 0 0 50 23 0 0 0 1 0\n", "P0: fx: 0"),
    ],
)
def test_a_bad_file_is_named(tmp_path: Path, name: str, text: str | None, word: str) -> None:
    path = write_kitti(tmp_path) / name
    path.unlink() if text is None else path.write_text(text)

    with pytest.raises(RecordingError, match=word):
        open_recording(path.parent)


def test_a_sequence_without_readable_images_says_why(tmp_path: Path) -> None:
    root = write_kitti(tmp_path)
    for path in (root / "image_0").iterdir():
        path.unlink()

    with pytest.raises(RecordingError, match=r"no image can be read; .*000000\.png: is missing"):
        open_recording(root)


def test_images_may_end_before_the_times_and_that_is_said_once(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    root = write_kitti(tmp_path, 5)
    for i in (1, 3, 4):
        (root / "image_0" / f"{i:06d}.png").unlink()
    recording = open_recording(root)

    assert [record.getMessage() for record in caplog.records] == [
        f"event=recording_ends_early folder={root / 'image_0'} images=3 times=5"
    ]
    assert [frame.index for frame in recording] == [0, 2]
    assert recording.t_ns.tolist() == [0, 100_000_000, 200_000_000]
    assert recording.groundtruth is not None
    assert len(recording.groundtruth.t_ns) == 5


def test_images_without_a_time_are_refused(tmp_path: Path) -> None:
    root = write_kitti(tmp_path)
    (root / "times.txt").write_text("0.0\n0.1\n")

    with pytest.raises(RecordingError, match=r"has an image 000002\.png, times\.txt has 2 times"):
        open_recording(root)


def test_poses_that_are_no_rigid_transforms_are_refused_by_their_line(tmp_path: Path) -> None:
    root = write_kitti(tmp_path)
    path = tmp_path / "poses" / "07.txt"
    path.write_text(
        path.read_text().replace("1 0 0 0 0 1 0 0 0 0 1 1\n", "2 0 0 0 0 1 0 0 0 0 1 1\n")
    )
    with pytest.raises(RecordingError, match=r"07.txt line 2: is no rigid transform"):
        _ = open_recording(root).groundtruth
