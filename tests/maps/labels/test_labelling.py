# SPDX-License-Identifier: Apache-2.0
"""A blue ball before a grey wall, found by the model of key colours in the build's own images."""

from pathlib import Path

import cv2
import numpy as np
import onnx
import pytest

from edge.errors import ModelRefused
from edge.tiles.labels import read_labels
from edge.tiles.reader import open_map
from edge.types import U8, Mat4
from maps.build import BuildInput, build
from maps.cli import main
from maps.settings import BuildSettings
from maps.verification import verify
from tests.edge.changes.scenes import ball_detection
from tests.maps.drive_folder import KnownView, write_drive
from tests.maps.wall_drive import CAMERA, picture, poses, wall
from tools.key_colour_model import make_model
from tools.simworld.objects import KEY_COLOURS

N_VIEWS = 8
CENTER, RADIUS_M = np.array([0.05, 0.05, 1.5]), 0.12

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("labelling") / "wall"
    paint = wall()
    views = (KnownView(_with_ball(picture(paint, T), T), T, None) for T in poses(N_VIEWS))
    return write_drive(folder, CAMERA, views, first_s=10.0)


def _with_ball(grey: U8, T: Mat4) -> U8:
    image = cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR)
    (mask,) = ball_detection([(0, CENTER, RADIUS_M)], T, CAMERA).masks
    h, w = mask.inside.shape
    part = image[mask.top : mask.top + h, mask.left : mask.left + w]
    part[mask.inside] = np.array(KEY_COLOURS["mug"], np.uint8)
    return np.asarray(image, np.uint8)


def test_a_build_with_a_model_knows_the_objects(
    drive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model = tmp_path / "key.onnx"
    onnx.save(make_model(), model)

    command = ["build", str(drive), "--out", str(tmp_path / "map"), "--segmenter", str(model)]
    assert main(command) == 0
    assert main(["verify", str(tmp_path / "map")]) == 0
    assert main(["inspect", str(tmp_path / "map")]) == 0

    assert "labels" in capsys.readouterr().out
    labels = read_labels(open_map(tmp_path / "map"))
    assert labels is not None
    (thing,) = labels.objects
    assert labels.names[thing.label] == "mug"
    assert np.linalg.norm(thing.center - CENTER) < 0.04
    assert thing.hit_rate == 1.0
    assert thing.portraits
    for portrait in thing.portraits:  # the ball is before the wall
        assert portrait.grey[12:20, 12:20].std() < 3.0 < portrait.grey.std()
    boxes, _, scores = labels.detections(0)
    assert len(boxes) == len(scores) == 1


def test_a_model_that_cannot_be_used_leaves_no_map(drive: Path, tmp_path: Path) -> None:
    (tmp_path / "bad.onnx").write_bytes(b"nothing")

    with pytest.raises(ModelRefused, match=r"bad\.onnx"):
        build(
            BuildInput([drive]),
            tmp_path / "map",
            BuildSettings(),
            segmenter=tmp_path / "bad.onnx",
        )

    assert [path.name for path in tmp_path.iterdir()] == ["bad.onnx"]


def test_a_map_of_a_later_build_without_model_has_no_labels(drive: Path, tmp_path: Path) -> None:
    build(BuildInput([drive]), tmp_path / "map", BuildSettings())

    verify(tmp_path / "map")
    assert read_labels(open_map(tmp_path / "map")) is None
