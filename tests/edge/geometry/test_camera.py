# SPDX-License-Identifier: Apache-2.0
from pathlib import Path

import cv2
import numpy as np
import pytest

from edge.errors import ConfigError
from edge.geometry import se3
from edge.geometry.camera import CameraModel, load_camera, load_camera_file
from edge.types import Pinhole

EUROC = CameraModel(
    *(752, 480, 458.654, 457.296, 367.215, 248.375, "radtan"),
    (-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05),
)
FISHEYE = CameraModel(
    640, 480, 290.0, 291.0, 320.5, 239.0, "equidistant", (-0.01, 0.02, -0.015, 0.003)
)
FOLDING = CameraModel(640, 480, 400.0, 400.0, 320.0, 240.0, "radtan", (-0.3, 0.0, 0.0, 0.0))

TOML = """
width = 640
height = 480
fx = 420.0
fy = 421
cx = 319.5
cy = 239.5
distortion_model = "radtan"
distortion = [-0.28, 0.07, 0.0002, 1.7e-05]
rate_hz = 20
"""


def matrix(camera: CameraModel) -> np.ndarray:
    return np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])


def all_pixels(width: int, height: int) -> np.ndarray:
    return np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).reshape(-1, 2)


@pytest.mark.parametrize("camera", [EUROC, FISHEYE], ids=["euroc", "fisheye"])
def test_every_raw_pixel_has_an_ideal_one_that_leads_back(camera: CameraModel) -> None:
    raw = all_pixels(camera.width, camera.height)[::37].astype(np.float64)

    assert camera.distort_pixels(camera.undistort_pixels(raw)) == pytest.approx(raw, abs=1e-8)


def test_the_ideal_camera_has_the_same_matrix() -> None:
    assert EUROC.pinhole == Pinhole(752, 480, 458.654, 457.296, 367.215, 248.375)


def test_projection_is_opencvs_and_nan_behind_the_camera() -> None:
    points = np.array([[0.3, -0.2, 1.0], [1.0, 0.5, 2.0], [0.3, -0.2, -1.0], [0.1, 0.1, 0.0]])
    theirs, _ = cv2.projectPoints(
        points[:2], np.zeros(3), np.zeros(3), matrix(EUROC), np.array(EUROC.distortion)
    )
    pixels = EUROC.project(points)

    assert pixels[:2] == pytest.approx(theirs[:, 0], abs=1e-9)
    assert np.isnan(pixels[2:]).all()


def test_maps_are_opencvs_for_radtan() -> None:
    K, k = matrix(EUROC), np.array(EUROC.distortion)
    x, y = cv2.initUndistortRectifyMap(K, k, None, K, (752, 480), cv2.CV_32FC1)
    map_x, map_y, _ = EUROC.undistortion_maps()

    assert np.abs(map_x - x).max() < 1e-3
    assert np.abs(map_y - y).max() < 1e-3


def test_maps_are_opencvs_for_a_fisheye() -> None:
    K, k = matrix(FISHEYE), np.array(FISHEYE.distortion)
    x, y = cv2.fisheye.initUndistortRectifyMap(K, k, np.eye(3), K, (640, 480), cv2.CV_32FC1)
    map_x, map_y, _ = FISHEYE.undistortion_maps()

    assert np.abs(map_x - x).max() < 1e-3
    assert np.abs(map_y - y).max() < 1e-3


def test_maps_give_arrays_that_remap_takes() -> None:
    map_x, map_y, valid = EUROC.undistortion_maps()
    ideal = cv2.remap(np.full((480, 752), 99, np.uint8), map_x, map_y, cv2.INTER_LINEAR)

    assert map_x.dtype == map_y.dtype == np.float32
    assert map_x.flags.c_contiguous
    assert map_y.flags.c_contiguous
    assert (ideal[valid == 1] == 99).all()


def test_valid_marks_sources_with_a_pixel_around_them() -> None:
    plain = CameraModel(64, 48, 50.0, 50.0, 31.5, 23.5)
    _, _, valid = plain.undistortion_maps()

    assert valid[1:-1, 1:-1].all()
    assert valid.sum() == 62 * 46


def test_a_wider_view_than_the_lens_has_is_not_valid_there() -> None:
    wide = Pinhole(640, 480, 100.0, 100.0, 319.5, 239.5)
    map_x, map_y, valid = FISHEYE.undistortion_maps(wide)
    inside = (map_x >= 1) & (map_x <= 638) & (map_y >= 1) & (map_y <= 478)

    assert np.array_equal(valid == 1, inside)
    assert 0.05 < valid.mean() < 0.95


def test_a_lens_that_folds_back_is_not_valid_beyond_the_fold() -> None:
    wide = Pinhole(640, 480, 150.0, 150.0, 320.0, 240.0)
    map_x, _, valid = FOLDING.undistortion_maps(wide)
    v, u = np.mgrid[:480, :640]
    radius = np.hypot((u - 320.0) / 150.0, (v - 240.0) / 150.0)
    beyond = radius > np.sqrt(1.0 / 0.9)

    assert not valid[beyond].any()
    assert (map_x[beyond] == -1).all()
    assert valid[radius < 0.6].all()
    # The formula alone would put some of them back into the image.
    x = (u - 320.0) / 150.0 * (1.0 - 0.3 * radius**2) * 400.0 + 320.0
    assert (beyond & (x > 1) & (x < 638)).any()


def test_load_reads_the_keys(tmp_path: Path) -> None:
    path = tmp_path / "camera.toml"
    path.write_text(TOML)
    file = load_camera_file(path)

    assert file.camera == load_camera(path)
    assert file.camera.pinhole == Pinhole(640, 480, 420.0, 421.0, 319.5, 239.5)
    assert file.camera.distortion == (-0.28, 0.07, 0.0002, 1.7e-05)
    assert (file.rate_hz, file.T_left_right) == (20.0, None)


def test_load_reads_the_pose_of_the_right_camera(tmp_path: Path) -> None:
    T = se3.exp([0.11, 0.0, 0.0, 0.0, 0.01, 0.0])
    path = tmp_path / "camera_right.toml"
    path.write_text(TOML + f"T_left_right = {np.round(T, 9).tolist()}")
    loaded = load_camera_file(path).T_left_right

    assert loaded == pytest.approx(T, abs=1e-8)
    assert loaded[:3, :3] @ loaded[:3, :3].T == pytest.approx(np.eye(3), abs=1e-15)


@pytest.mark.parametrize(
    ("old", "new", "word"),
    [
        ("fx = 420.0", "", "'fx' is missing"),
        ("fx = 420.0", "fx = -420.0", "fx: -420"),
        ("fx = 420.0", "fx = 0", "fx: 0"),
        ("fx = 420.0", "fx = nan", "fx: nan"),
        ("fx = 420.0", 'fx = "420"', "fx: '420' is no number"),
        ("fx = 420.0", "fx = true", "fx: True is no number"),
        ("fx = 420.0", "fx = = 3", "is not TOML"),
        ("cx = 319.5", "cx = 3195", "cx: 3195 lies outside"),
        ("cy = 239.5", "cy = -1", "cy: -1 lies outside"),
        ("width = 640", "width = 640.5", "width: 640.5"),
        ("width = 640", "width = 0", "width: 0 is impossible"),
        ("width = 640", "width = 640000", "width: 640000 is impossible"),
        ("rate_hz = 20", "rate_hz = 0", "rate_hz: 0"),
        ("rate_hz = 20", "rate_hz = -1.0", "rate_hz: -1"),
        ("rate_hz = 20", "rate = 20", "unknown key 'rate'"),
        ('"radtan"', '"fov"', "'fov' is unknown"),
        ('"radtan"', "7", "distortion_model: must be a string"),
        ('"radtan"', '"none"', "4 coefficients; none takes 0"),
        ("1.7e-05]", "1.7e-05, 0.0, 0.0]", "6 coefficients; radtan takes 4 or 5 or 8"),
        ("0.07,", "inf,", "distortion: inf is not finite"),
        ("0.07,", "7e7,", "distortion: a coefficient is above"),
        ("rate_hz = 20", "T_left_right = [[1, 0], [0, 1]]", "T_left_right: must have 4 rows"),
        (
            "rate_hz = 20",
            "T_left_right = [[2,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]",
            "T_left_right: is no rigid",
        ),
        (
            "rate_hz = 20",
            "T_left_right = [[-1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]",
            "T_left_right: is no rigid",
        ),
    ],
)
def test_a_bad_key_is_named_in_one_line(tmp_path: Path, old: str, new: str, word: str) -> None:
    path = tmp_path / "camera.toml"
    assert old in TOML
    path.write_text(TOML.replace(old, new))

    with pytest.raises(ConfigError) as caught:
        load_camera(path)
    message = str(caught.value)
    assert message.startswith(str(path))
    assert word in message
    assert "\n" not in message


def test_a_missing_file_and_a_folder_are_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"camera\.toml: no such file"):
        load_camera(tmp_path / "camera.toml")
    with pytest.raises(ConfigError, match="cannot be read"):
        load_camera(tmp_path)


def test_endless_brackets_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "camera.toml"
    path.write_text("width = " + "[" * 5000)

    with pytest.raises(ConfigError, match="is not TOML"):
        load_camera(path)


def test_a_binary_file_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "camera.toml"
    path.write_bytes(b"\xff\xd8\xff\xe0")

    with pytest.raises(ConfigError, match="is no UTF-8 text"):
        load_camera(path)
