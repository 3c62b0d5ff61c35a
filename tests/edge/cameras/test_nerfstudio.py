# SPDX-License-Identifier: Apache-2.0
import json
from pathlib import Path

import numpy as np
import pytest

from edge.cameras.recording import open_recording
from edge.errors import RecordingError
from tests.edge.cameras.posed_collections import names, pose, write_nerfstudio
from tests.edge.cameras.recordings import HEIGHT, WIDTH, picture, write_image


def test_poses_look_along_z_and_images_are_in_the_order_of_names(tmp_path: Path) -> None:
    recording = open_recording(write_nerfstudio(tmp_path))
    truth = recording.groundtruth
    assert truth is not None
    np.testing.assert_allclose(truth.T_world_cam, [pose(i) for i in range(3)], atol=1e-12)
    image = recording.image(2)
    assert image is not None
    np.testing.assert_array_equal(image, picture(2))
    assert recording.camera.pinhole == (WIDTH, HEIGHT, 50.0, 51.0, 31.5, 23.5)
    assert not recording.metric


@pytest.mark.parametrize(
    ("keys", "model", "distortion"),
    [
        ({"k1": 0.1, "p2": 0.3}, "radtan", (0.1, 0, 0, 0.3)),
        ({"k1": 0.1, "k3": 0.2}, "radtan", (0.1, 0, 0, 0, 0.2)),
        ({"camera_model": "OPENCV_FISHEYE", "k1": 0.1, "k4": 0.4}, "equidistant", (0.1, 0, 0, 0.4)),
    ],
)
def test_lenses_are_carried(
    tmp_path: Path, keys: dict[str, object], model: str, distortion: tuple[float, ...]
) -> None:
    camera = open_recording(write_nerfstudio(tmp_path, **keys)).camera
    assert (camera.distortion_model, camera.distortion) == (model, distortion)


def test_a_field_of_view_stands_for_a_focal_length_and_the_image_for_its_size(
    tmp_path: Path,
) -> None:
    path = write_nerfstudio(tmp_path, camera_angle_x=2.0 * np.arctan(0.5)) / "transforms.json"
    table = json.loads(path.read_text())
    for key in ("w", "h", "fl_x", "fl_y", "cx", "cy"):
        del table[key]
    for frame in table["frames"]:
        frame["file_path"] = frame["file_path"].removesuffix(".png")
    path.write_text(json.dumps(table))
    recording = open_recording(tmp_path)
    assert recording.camera.pinhole == pytest.approx((WIDTH, HEIGHT, WIDTH, WIDTH, 31.5, 23.5))
    assert recording.image(0) is not None


def test_frames_may_have_cameras_of_their_own(tmp_path: Path) -> None:
    recording = open_recording(write_nerfstudio(tmp_path, frames=[{}, {"fl_x": 40.0}]))
    assert [recording.camera_at(i).fx for i in range(3)] == [50.0, 40.0, 50.0]


def test_depth_images_are_in_the_unit_of_the_poses(tmp_path: Path) -> None:
    write_nerfstudio(tmp_path, frames=[{"depth_file_path": "depth/0.png"}])
    write_image(tmp_path / "depth" / "0.png", np.full((HEIGHT, WIDTH), 1500, np.uint16))
    recording = open_recording(tmp_path)
    depth = recording.depth(0)
    assert depth is not None
    assert depth[3, 4] == pytest.approx(1.5)
    assert recording.depth(1) is None
    assert recording.depth_in_pose_units


@pytest.mark.parametrize(
    ("keys", "frame", "said"),
    [
        ({"frames": []}, {}, "lists no image"),
        ({"frames": [{}]}, {}, "no 'file_path'"),
        ({"camera_model": "EQUIRECTANGULAR"}, {}, "model EQUIRECTANGULAR"),
        ({"k4": 0.1}, {}, "model OPENCV with its k and p"),
        ({"fl_x": "long"}, {}, "'fl_x' is no finite number"),
        ({"fl_x": 0.001}, {}, "fx"),
        ({}, {"transform_matrix": [[1, 0, 0, 0]] * 4}, "no rigid transform"),
        ({}, {"transform_matrix": [[1, 0], [0, 1]]}, "no pose"),
        ({}, {"transform_matrix": None}, "no pose"),
        ({}, {"transform_matrix": [[float("nan")] * 4] * 4}, "not finite"),
    ],
)
def test_what_is_wrong_is_said_in_one_line(
    tmp_path: Path, keys: dict[str, object], frame: dict[str, object], said: str
) -> None:
    write_nerfstudio(tmp_path, **({"frames": [frame]} | keys))  # type: ignore[arg-type]
    if "frames" in keys:
        path = tmp_path / "transforms.json"
        path.write_text(json.dumps(json.loads(path.read_text()) | keys))
    with pytest.raises(RecordingError, match=said) as refused:
        _ = open_recording(tmp_path).groundtruth
    assert "\n" not in str(refused.value)


def test_a_file_that_is_no_json_is_refused(tmp_path: Path) -> None:
    (tmp_path / "transforms.json").write_text("{")
    with pytest.raises(RecordingError, match="no JSON"):
        open_recording(tmp_path)
    (tmp_path / "transforms.json").write_text("[]")
    with pytest.raises(RecordingError, match="no table"):
        open_recording(tmp_path)


@pytest.mark.parametrize("name", ["x" * 300, "a\0b.png"])
def test_a_name_that_no_file_can_have_is_refused(tmp_path: Path, name: str) -> None:
    write_nerfstudio(tmp_path, 1, frames=[{"file_path": name}])
    with pytest.raises(RecordingError, match="cannot be read"):
        open_recording(tmp_path).needed_image(0)


def test_an_image_that_is_missing_is_named_when_it_is_read(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    write_nerfstudio(tmp_path)
    (tmp_path / names(1)[0]).unlink()
    recording = open_recording(tmp_path)
    assert recording.image(0) is None
    assert names(1)[0] in caplog.text
