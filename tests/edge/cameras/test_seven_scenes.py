# SPDX-License-Identifier: Apache-2.0
from pathlib import Path

import numpy as np
import pytest

from edge.cameras.recording import open_recording
from edge.errors import RecordingError
from tests.edge.cameras.posed_collections import pose, write_seven_scenes
from tests.edge.cameras.recordings import CAMERA_TOML, picture, write_image


def test_frames_without_a_pose_have_none_and_times_follow_their_numbers(tmp_path: Path) -> None:
    recording = open_recording(write_seven_scenes(tmp_path))
    assert recording.t_ns.tolist() == [166_666_666, 200_000_000, 233_333_333]
    truth = recording.groundtruth
    assert truth is not None
    assert truth.t_ns.tolist() == [166_666_666, 233_333_333]
    np.testing.assert_allclose(truth.T_world_cam, [pose(0), pose(2)], atol=1e-8)
    assert truth.pose_at(200_000_000) is None
    image = recording.image(2)
    assert image is not None
    np.testing.assert_array_equal(image, picture(2, 640, 480))
    assert recording.camera.fx == 525.0
    assert not recording.has_depth
    assert recording.metric


def test_a_calibration_in_the_folder_comes_first(tmp_path: Path) -> None:
    write_seven_scenes(tmp_path)
    (tmp_path / "camera.toml").write_text(CAMERA_TOML)
    recording = open_recording(tmp_path)
    assert (recording.camera.fx, recording.rate_hz) == (50.0, 20.0)
    (tmp_path / "camera.toml").write_text("width = 3")
    with pytest.raises(RecordingError, match=r"camera\.toml"):
        open_recording(tmp_path)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("1 0 0 0\n0 1 0 0\n0 0 1 nan\n0 0 0 1\n", "not finite"),
        ("1 0 0 0\n0 1 0 0\n0 0 2 0\n0 0 0 1\n", "no rigid transform"),
        ("-1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n", "no rigid transform"),
        ("1 0 0 0\n", "no pose of 4 rows"),
        ("1 0 0\n", "3 columns"),
    ],
)
def test_an_impossible_pose_is_refused_by_its_file(tmp_path: Path, text: str, said: str) -> None:
    write_seven_scenes(tmp_path)
    path = tmp_path / "frame-000007.pose.txt"
    path.write_text(text)
    with pytest.raises(RecordingError, match=said) as refused:
        _ = open_recording(tmp_path).groundtruth
    assert str(path) in str(refused.value)


def test_no_poses_are_no_truth_and_odd_names_are_refused(tmp_path: Path) -> None:
    write_seven_scenes(tmp_path)
    for path in tmp_path.glob("*.pose.txt"):
        path.unlink()
    assert open_recording(tmp_path).groundtruth is None
    write_image(tmp_path / "frame-last.color.png", picture(0))
    with pytest.raises(RecordingError, match="frame-last"):
        open_recording(tmp_path)
