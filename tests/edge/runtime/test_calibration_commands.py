# SPDX-License-Identifier: Apache-2.0
from pathlib import Path

import cv2
import numpy as np
import pytest

from edge.capture.format import Header
from edge.capture.writer import CaptureWriter
from edge.cli import main
from edge.geometry.camera import CameraModel, load_camera_file
from tests.edge.runtime.board_images import board_poses, render

CAMERA = CameraModel(480, 360, 315.0, 316.0, 240.0, 179.0, "radtan", (-0.2, 0.05, 0.0, 0.0, 0.0))
COUNT = 16
BOARD = ["--board", "9x6", "--square", "0.03"]

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def images() -> list[np.ndarray]:
    return [render(CAMERA, T, n) for n, T in enumerate(board_poses(COUNT, seed=5))]


@pytest.fixture(scope="module")
def folder(images: list[np.ndarray], tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("board")
    for number, image in enumerate(images):
        cv2.imwrite(str(folder / f"{number:02d}.png"), image)
    return folder


def test_a_folder_of_images_gives_a_camera_and_a_picture(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "camera.toml"
    arguments = ["calibrate", str(folder), *BOARD, "--model", "radtan", "--identity", "serial:A1"]
    assert main([*arguments, "--rate-hz", "25", "--out", str(out)]) == 0
    file = load_camera_file(out)
    assert file.camera.fx == pytest.approx(CAMERA.fx, rel=0.005)
    assert (file.identity, file.rate_hz) == ("serial:A1", 25.0)
    assert out.read_text().startswith(f"# calibrated from {COUNT} of {COUNT} images of a 9x6 board")
    picture = cv2.imread(str(tmp_path / "camera.png"))
    assert picture is not None
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 5
    said = capsys.readouterr().out
    assert "rms 0." in said
    assert "earlier" not in said


def test_a_file_that_is_no_calibration_is_not_replaced_by_one(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "site.toml"
    out.write_text('[camera]\nsource = "v4l2"\n')
    assert main(["calibrate", str(folder), *BOARD, "--out", str(out)]) == 2
    assert "site.toml: exists and is no calibration" in capsys.readouterr().err
    assert out.read_text().startswith("[camera]")


def test_a_recording_binds_the_calibration_to_its_camera(
    images: list[np.ndarray], tmp_path: Path
) -> None:
    path = tmp_path / "a.mcap"
    info = {"identity": "path:p serial:A1", "rate_hz": "30.0"}
    with CaptureWriter(path, Header("", "s", 0, info), {}) as writer:
        for number, image in enumerate(images):
            writer.add_image(number * 33_000_000, number, image)
        writer.finish()
    assert main(["replay", str(path), "--out", str(tmp_path / "run")]) == 2  # not calibrated yet
    out = tmp_path / "camera.toml"
    assert main(["calibrate", str(path), *BOARD, "--model", "radtan", "--out", str(out)]) == 0
    file = load_camera_file(out)
    assert (file.identity, file.rate_hz) == ("path:p serial:A1", 30.0)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--board", "7x5"], ["only", "show the board well"]),
        (["--dictionary", "DICT_5X5_50"], ["only 0 of", "check --board and --dictionary"]),
        (["--dictionary", "DICT_9"], ["--dictionary DICT_9: is unknown"]),
        (["--marker", "0.04"], ["--marker 0.04: must be"]),
    ],
)
def test_wrong_boards_are_refused_and_nothing_is_written(
    folder: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    words: list[str],
) -> None:
    few = [str(path) for path in sorted(folder.iterdir())[:3]]
    out = tmp_path / "camera.toml"
    assert main(["calibrate", *few, *arguments, "--out", str(out)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert all(word in line for word in words), line
    assert not list(tmp_path.iterdir())


def test_images_of_two_sizes_are_refused(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = tmp_path / "other.png"
    cv2.imwrite(str(other), np.zeros((100, 200), np.uint8))
    first = str(min(folder.iterdir()))
    assert main(["calibrate", first, str(other), "--out", str(tmp_path / "c.toml")]) == 2
    assert "is 200x100, the others are 480x360" in capsys.readouterr().err


def test_the_board_is_drawn_as_it_will_be_found(tmp_path: Path) -> None:
    out = tmp_path / "board.png"
    assert main(["board", "--board", "7x5", "--out", str(out)]) == 0
    picture = cv2.imread(str(out), cv2.IMREAD_GRAYSCALE)
    assert picture is not None
    assert picture.shape == (7 * 200, 9 * 200)
