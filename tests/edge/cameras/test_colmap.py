# SPDX-License-Identifier: Apache-2.0
import logging
from pathlib import Path

import numpy as np
import pytest

from edge.cameras import colmap_files
from edge.cameras.recording import open_recording
from edge.errors import RecordingError
from tests.edge.cameras.posed_collections import (
    PINHOLE,
    names,
    pose,
    write_colmap,
    write_depth_map,
)
from tests.edge.cameras.recordings import HEIGHT, WIDTH, picture


@pytest.mark.parametrize("binary", [True, False])
def test_poses_and_images_are_in_the_order_of_names(tmp_path: Path, binary: bool) -> None:
    recording = open_recording(write_colmap(tmp_path, binary=binary))
    truth = recording.groundtruth
    assert truth is not None
    np.testing.assert_allclose(truth.T_world_cam, [pose(i) for i in range(3)], atol=1e-12)
    assert recording.t_ns.tolist() == truth.t_ns.tolist() == [0, 10**9, 2 * 10**9]
    for i in range(3):
        image = recording.image(i)
        assert image is not None
        np.testing.assert_array_equal(image, picture(i))
    assert not recording.metric


@pytest.mark.parametrize("binary", [True, False])
def test_points_and_what_shows_them(tmp_path: Path, binary: bool) -> None:
    folder = write_colmap(tmp_path, binary=binary) / "sparse" / "0"
    points = colmap_files.read_points(folder)
    assert points.number.tolist() == [3, 7]
    np.testing.assert_array_equal(points.xyz, [[0.5, -1.0, 4.0], [1.0, 2.0, 5.0]])
    image = colmap_files.read_images(folder)[1]
    assert (image.number, image.name) == (29, names(2)[1])
    np.testing.assert_array_equal(image.pixels, [[10.0, 20.0], [39.75, 8.0]])
    assert image.point.tolist() == [7, 3]


@pytest.mark.parametrize(
    ("number", "name", "parameters", "model", "distortion"),
    [
        (0, "SIMPLE_PINHOLE", [50.0, 32.0, 24.0], "none", ()),
        (2, "SIMPLE_RADIAL", [50.0, 32.0, 24.0, 0.1], "radtan", (0.1, 0, 0, 0)),
        (3, "RADIAL", [50.0, 32.0, 24.0, 0.1, 0.2], "radtan", (0.1, 0.2, 0, 0)),
        (4, "OPENCV", [50.0, 50.0, 32.0, 24.0, 0.1, 0.2, 0.3, 0.4], "radtan", (0.1, 0.2, 0.3, 0.4)),
        (5, "OPENCV_FISHEYE", [50.0, 50.0, 32.0, 24.0, 1, 2, 3, 4], "equidistant", (1, 2, 3, 4)),
        (
            6,
            "FULL_OPENCV",
            [50.0, 50.0, 32.0, 24.0, *range(1, 9)],
            "radtan",
            tuple(map(float, range(1, 9))),
        ),
        (8, "SIMPLE_RADIAL_FISHEYE", [50.0, 32.0, 24.0, 0.1], "equidistant", (0.1, 0, 0, 0)),
        (9, "RADIAL_FISHEYE", [50.0, 32.0, 24.0, 0.1, 0.2], "equidistant", (0.1, 0.2, 0, 0)),
        (
            10,
            "THIN_PRISM_FISHEYE",
            [50.0, 50.0, 32.0, 24.0, 0.1, 0.2, 0, 0, 0.3, 0.4, 0, 0],
            "equidistant",
            (0.1, 0.2, 0.3, 0.4),
        ),
        (14, "SIMPLE_FISHEYE", [50.0, 32.0, 24.0], "equidistant", (0, 0, 0, 0)),
    ],
)
@pytest.mark.parametrize("binary", [True, False])
def test_cameras_are_carried(
    tmp_path: Path,
    number: int,
    name: str,
    parameters: list[float],
    model: str,
    distortion: tuple[float, ...],
    binary: bool,
) -> None:
    values = list(map(float, parameters))
    write_colmap(tmp_path, binary=binary, cameras={4: (number, name, values)})
    camera = open_recording(tmp_path).camera
    assert camera.pinhole == (WIDTH, HEIGHT, 50.0, 50.0, 31.5, 23.5)
    assert (camera.distortion_model, camera.distortion) == (model, distortion)


@pytest.mark.parametrize(
    ("number", "name", "count"),
    [
        (7, "FOV", 5),
        (10, "THIN_PRISM_FISHEYE", 12),
        (11, "RAD_TAN_THIN_PRISM_FISHEYE", 16),
        (12, "SIMPLE_DIVISION", 4),
        (13, "DIVISION", 5),
        (16, "EUCM", 6),
        (17, "EQUIRECTANGULAR", 2),
    ],
)
@pytest.mark.parametrize("binary", [True, False])
def test_other_cameras_are_refused_by_name(
    tmp_path: Path, number: int, name: str, count: int, binary: bool
) -> None:
    write_colmap(tmp_path, binary=binary, cameras={1: (number, name, [1.0] * count)})
    with pytest.raises(RecordingError, match=rf"camera 1: model {name} cannot be carried"):
        open_recording(tmp_path)


def test_a_camera_of_an_unknown_number_is_refused(tmp_path: Path) -> None:
    write_colmap(tmp_path, cameras={1: (99, "NEW", [1.0])})
    with pytest.raises(RecordingError, match="model number 99 is unknown"):
        open_recording(tmp_path)


def test_images_of_several_cameras_keep_their_own_and_are_not_played(tmp_path: Path) -> None:
    wide = {2: (0, "SIMPLE_PINHOLE", [30.0, 32.0, 24.0])}
    recording = open_recording(write_colmap(tmp_path, cameras=PINHOLE | wide))
    assert [recording.camera_at(i).fx for i in range(3)] == [50.0, 30.0, 50.0]
    assert len(recording.cameras) == 2
    with pytest.raises(RecordingError, match="2 cameras"):
        next(iter(recording))


def test_depth_maps_come_in_the_size_of_the_images(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    write_colmap(tmp_path)
    maps = tmp_path / "stereo" / "depth_maps"
    full = np.linspace(1.0, 2.0, WIDTH * HEIGHT, dtype=np.float32).reshape(HEIGHT, WIDTH)
    full[0, :3] = np.nan, -1.0, np.inf
    small = np.array([[1.0, 2.0], [3.0, 4.0]])
    write_depth_map(maps / f"{names(1)[0]}.geometric.bin", full)
    write_depth_map(maps / f"{names(3)[2]}.geometric.bin", small)
    recording = open_recording(tmp_path)
    assert recording.has_depth
    assert recording.depth_in_pose_units
    depth = recording.depth(0)
    assert depth is not None
    assert depth[0, :3].tolist() == [0.0, 0.0, 0.0]
    np.testing.assert_array_equal(depth[1:], full[1:])
    assert recording.depth(1) is None
    depth = recording.depth(2)
    assert depth is not None
    assert depth.shape == (HEIGHT, WIDTH)
    assert (depth[0, 0], depth[0, -1], depth[-1, 0], depth[-1, -1]) == (1.0, 2.0, 3.0, 4.0)
    assert set(np.unique(depth)) == {1.0, 2.0, 3.0, 4.0}  # surfaces are not mixed
    assert caplog.text == ""


@pytest.mark.parametrize("data", [b"no map", b"2&2&1&1234", b"2&2&2&" + b"0" * 32, b"99999&1&1&"])
def test_damaged_depth_maps_are_skipped_with_a_line(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, data: bytes
) -> None:
    write_colmap(tmp_path)
    path = tmp_path / "stereo" / "depth_maps" / f"{names(1)[0]}.geometric.bin"
    path.parent.mkdir(parents=True)
    (path.parent / "left").mkdir()
    path.write_bytes(data)
    with caplog.at_level(logging.WARNING):
        assert open_recording(tmp_path).depth(0) is None
    assert str(path) in caplog.text


def test_a_model_in_a_workspace_can_be_given_alone(tmp_path: Path) -> None:
    write_colmap(tmp_path)
    write_colmap(tmp_path, 2, model="1")
    with pytest.raises(RecordingError, match=r"2 models .* \(0: 3 images, 1: 2 images\)"):
        open_recording(tmp_path)
    assert len(open_recording(tmp_path / "sparse" / "1")) == 2
    assert open_recording(tmp_path / "sparse" / "1").image(1) is not None


def test_images_that_are_not_there_are_named(tmp_path: Path) -> None:
    write_colmap(tmp_path)
    (tmp_path / "images").rename(tmp_path / "pictures")
    with pytest.raises(RecordingError, match=f"image {names(1)[0]} lies neither"):
        open_recording(tmp_path)


def read_all(folder: Path) -> None:
    colmap_files.read_cameras(folder)
    colmap_files.read_images(folder)
    colmap_files.read_points(folder)


@pytest.mark.parametrize("stem", ["cameras", "images", "points3D"])
def test_a_file_cut_short_anywhere_is_refused(tmp_path: Path, stem: str) -> None:
    folder = write_colmap(tmp_path) / "sparse" / "0"
    path = folder / f"{stem}.bin"
    whole = path.read_bytes()
    for length in range(len(whole)):
        path.write_bytes(whole[:length])
        with pytest.raises(RecordingError, match=str(path)):
            read_all(folder)


@pytest.mark.parametrize("stem", ["cameras", "images", "points3D"])
def test_absurd_counts_take_no_memory(tmp_path: Path, stem: str) -> None:
    folder = write_colmap(tmp_path) / "sparse" / "0"
    path = folder / f"{stem}.bin"
    path.write_bytes(b"\xff" * 8 + path.read_bytes()[8:])
    with pytest.raises(RecordingError, match="damaged"):
        read_all(folder)


@pytest.mark.parametrize(
    ("stem", "line", "said"),
    [
        ("images", "10 1 0 0 0 0 0 nan 1 a.png", "no rigid transform"),
        ("images", "10 2 0 0 0 0 0 0 1 a.png", "no rigid transform"),
        ("images", "10 1 0 0 0 0 0 zero 1 a.png", "zero"),
        ("images", "10 1 0 0 0 0 0 0 a.png", "has 9 columns"),
        ("images", "10 1 0 0 0 0 0 0 9 left/000.png", "camera 9"),
        ("images", "", "no image"),
        ("cameras", "1 PINHOLE 64 48 50 50 32", "takes 4 parameters, there are 3"),
        ("cameras", "1 PINHOLE 64 48 50 50 32 900", "outside the image"),
        ("cameras", "one PINHOLE 64 48 50 50 32 24", "'one'"),
        ("cameras", "1 PINHOLE", "no camera"),
    ],
)
def test_what_is_wrong_in_a_text_model_is_said(
    tmp_path: Path, stem: str, line: str, said: str
) -> None:
    folder = write_colmap(tmp_path, binary=False) / "sparse" / "0"
    (folder / f"{stem}.txt").write_text(f"{line}\n\n" if line else "# nothing\n")
    with pytest.raises(RecordingError, match=said) as refused:
        open_recording(tmp_path)
    assert "\n" not in str(refused.value)
