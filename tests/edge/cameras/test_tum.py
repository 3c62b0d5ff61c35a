# SPDX-License-Identifier: Apache-2.0
from pathlib import Path

import numpy as np
import pytest

from edge.cameras.recording import open_recording
from edge.errors import RecordingError
from edge.geometry import se3
from tests.edge.cameras.recordings import CAMERA_TOML, picture, write_image, write_tum


def write_depth(root: Path, times: list[str], header: str = "# time_s path") -> None:
    for i in range(len(times)):
        write_image(root / "depth" / f"{i}.png", np.full((48, 64), 5000 + i, np.uint16))
    rows = [f"{t} depth/{i}.png" for i, t in enumerate(times)]
    (root / "depth.txt").write_text("\n".join([header, *rows]) + "\n")


def test_camera_rate_and_truth_are_read(tmp_path: Path) -> None:
    recording = open_recording(write_tum(tmp_path))

    assert recording.camera.pinhole == (64, 48, 50.0, 50.0, 31.5, 23.5)
    assert recording.rate_hz == 20.0
    assert recording.groundtruth is not None
    assert recording.groundtruth.pose_at(250_000_000)[0, 3] == pytest.approx(0.25)


def test_rate_is_taken_from_the_times_where_the_camera_says_none(tmp_path: Path) -> None:
    write_tum(tmp_path)
    (tmp_path / "camera.toml").write_text(CAMERA_TOML.replace("rate_hz = 20", ""))

    assert open_recording(tmp_path).rate_hz == pytest.approx(20.0)


def test_one_frame_does_not_tell_the_rate(tmp_path: Path) -> None:
    write_tum(tmp_path, 1)
    (tmp_path / "camera.toml").write_text(CAMERA_TOML.replace("rate_hz = 20", ""))

    with pytest.raises(RecordingError, match=r"camera\.toml: key 'rate_hz' is missing"):
        open_recording(tmp_path)


def test_times_are_exact_to_the_nanosecond(tmp_path: Path) -> None:
    write_tum(tmp_path)
    (tmp_path / "rgb.txt").write_text(
        "1403715273.262142976 rgb/000.png\n1403715273.262142977 rgb/001.png\n"
    )

    assert open_recording(tmp_path).t_ns.tolist() == [1403715273262142976, 1403715273262142977]


def test_depth_goes_to_the_frame_of_its_time(tmp_path: Path) -> None:
    write_tum(tmp_path)
    write_depth(tmp_path, ["0.000000", "0.148", "0.225"])
    recording = open_recording(tmp_path)

    depths = [recording.depth(i) for i in range(6)]
    assert [i for i, depth in enumerate(depths) if depth is not None] == [0, 3]
    assert depths[3] == pytest.approx(5.001)
    assert depths[3].dtype == np.float32
    assert recording.has_depth


def test_depth_of_the_benchmark_counts_5000_to_the_metre(tmp_path: Path) -> None:
    write_tum(tmp_path)
    write_depth(
        tmp_path, ["0.01"], "# depth maps\n# file: 'rgbd_dataset_freiburg1_xyz.bag'\n# timestamp f"
    )

    assert open_recording(tmp_path).depth(0) == pytest.approx(1.0)


def test_depth_of_a_quick_camera_is_not_shared_with_its_neighbours(tmp_path: Path) -> None:
    write_tum(tmp_path)
    rows = "".join(f"{0.01 * i:.3f} rgb/{i:03d}.png\n" for i in range(6))
    (tmp_path / "rgb.txt").write_text(rows)
    write_depth(tmp_path, ["0.02"])
    recording = open_recording(tmp_path)

    assert [i for i in range(6) if recording.depth(i) is not None] == [2]


def test_depth_of_another_size_is_skipped(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    write_tum(tmp_path)
    write_depth(tmp_path, ["0.0"])
    write_image(tmp_path / "depth" / "0.png", np.ones((24, 32), np.uint16))
    recording = open_recording(tmp_path)

    assert recording.depth(0) is None
    assert recording.dropped == 0
    assert "is 32x24, its camera is 64x48" in caplog.text


@pytest.mark.parametrize(
    ("folder", "fx", "lens"),
    [
        ("rgbd_dataset_freiburg1_xyz", 517.306408, 5),
        ("fr2_desk", 520.908620, 5),
        ("rgbd_dataset_freiburg3_long_office_household", 535.4, 0),
    ],
)
def test_the_camera_of_a_tum_folder_is_known_by_its_name(
    tmp_path: Path, folder: str, fx: float, lens: int
) -> None:
    root = write_tum(tmp_path / folder)
    (root / "camera.toml").unlink()
    for i in range(6):
        write_image(root / "rgb" / f"{i:03d}.png", picture(i, 640, 480))
    recording = open_recording(root)

    assert recording.camera.fx == fx
    assert len(recording.camera.distortion) == lens
    assert len(list(recording)) == 6


def test_another_name_without_a_camera_asks_for_one(tmp_path: Path) -> None:
    root = write_tum(tmp_path / "kitchen")
    (root / "camera.toml").unlink()

    with pytest.raises(RecordingError, match=r"camera\.toml: is missing .* write width"):
        open_recording(root)


def test_the_right_camera_is_read(tmp_path: Path) -> None:
    write_tum(tmp_path)
    T = se3.exp([0.11, 0.0, 0.0, 0.0, 0.01, 0.0])
    (tmp_path / "camera_right.toml").write_text(
        CAMERA_TOML.replace("fx = 50.0", "fx = 51.0") + f"T_left_right = {T.tolist()}\n"
    )
    write_image(tmp_path / "right" / "002.png", picture(9))
    recording = open_recording(tmp_path)

    assert recording.right_camera is not None
    assert recording.right_camera.fx == 51.0
    assert recording.T_left_right == pytest.approx(T)
    assert np.array_equal(recording.right(2), picture(9))
    assert recording.right(3) is None
    assert recording.dropped == 0


def test_a_right_camera_without_its_pose_is_refused(tmp_path: Path) -> None:
    write_tum(tmp_path)
    (tmp_path / "right").mkdir()
    with pytest.raises(RecordingError, match=r"camera_right\.toml: no such file"):
        open_recording(tmp_path)

    (tmp_path / "camera_right.toml").write_text(CAMERA_TOML)
    with pytest.raises(RecordingError, match=r"camera_right\.toml: key 'T_left_right'"):
        open_recording(tmp_path)


@pytest.mark.parametrize(
    ("text", "word"),
    [
        (None, "rgb.txt: is missing"),
        ("", "rgb.txt: lists no image"),
        ("# only words\n", "rgb.txt: lists no image"),
        ("0.1 rgb/000.png\n0.1 rgb/001.png\n", "line 2: time is not after"),
        ("0.2 rgb/000.png\n0.1 rgb/001.png\n", "line 2: time is not after"),
        ("0.1\n", "line 1: has no path"),
        ("zero rgb/000.png\n", "line 1: 'zero' is no time"),
        ("\x00\x01\x02", "rgb.txt: is no text file"),
    ],
)
def test_a_bad_list_is_named(tmp_path: Path, text: str | None, word: str) -> None:
    write_tum(tmp_path)
    if text is None:
        (tmp_path / "rgb.txt").unlink()
    else:
        (tmp_path / "rgb.txt").write_text(text)

    with pytest.raises(RecordingError, match=word) as caught:
        open_recording(tmp_path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("line", ["focal = 3", "fx = 1"])
def test_a_bad_camera_is_a_bad_recording(tmp_path: Path, line: str) -> None:
    write_tum(tmp_path)
    (tmp_path / "camera.toml").write_text(f"{CAMERA_TOML}{line}\n")

    with pytest.raises(RecordingError, match=r"camera\.toml: "):
        open_recording(tmp_path)
