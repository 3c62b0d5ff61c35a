# SPDX-License-Identifier: Apache-2.0
import re
from pathlib import Path

import cv2
import numpy as np
import pytest

from edge.cli import main
from edge.errors import ModelRefused
from edge.learned.picture import picture
from edge.runtime import model_commands
from edge.segmenter.process import SegmenterProcess
from tests.edge.segmenter.graphs import IMAGE_SIZE, THINGS, write_graph, write_rtmdet, write_yolov8
from tools.corner_model import make


@pytest.fixture
def image(tmp_path: Path) -> Path:
    path = tmp_path / "room.png"
    cv2.imwrite(str(path), np.full((IMAGE_SIZE[1], IMAGE_SIZE[0], 3), 90, np.uint8))
    return path


def test_check_says_the_contract_and_draws_the_masks(
    tmp_path: Path, image: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model, out = write_rtmdet(tmp_path / "m.onnx"), tmp_path / "masks.png"

    status = main(["model", "check", str(model), str(image), "--out", str(out)])

    said = capsys.readouterr()
    assert (status, said.err) == (0, "")
    assert "rtmdet, known from metadata and shapes" in said.out
    assert "images float32 nchw 64x64, bgr, scaled to fit, top left, pad 114" in said.out
    assert "dets float32 [1,4,5]: dets" in said.out
    assert "classes   3: cup, chair, book" in said.out
    assert "chair 0.90, 24,8 to 80,56, 1280 px" in said.out
    drawn = cv2.imread(str(out))
    left, top, right, bottom = THINGS[0].mask
    inside = drawn[top + 2 : bottom - 2, left + 2 : right - 2]
    assert (abs(inside.astype(int) - 90).max(axis=2) > 20).all()
    assert (drawn[60:, :20] == 90).all()


def test_an_image_may_come_after_the_options(tmp_path: Path, image: Path) -> None:
    model, out = write_rtmdet(tmp_path / "m.onnx"), tmp_path / "masks.png"

    assert main(["model", "check", str(model), "--out", str(out), str(image)]) == 0

    assert out.exists()


def test_check_without_an_image_runs_it_too(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["model", "check", str(write_yolov8(tmp_path / "m.onnx"))]) == 0

    assert "ms of processor time an image" in capsys.readouterr().out


def test_a_model_of_features_is_known_as_one(
    tmp_path: Path, image: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model, out = make(tmp_path / "corners.onnx"), tmp_path / "points.png"
    cv2.imwrite(str(image), picture(320, 240))

    status = main(["model", "check", str(model), str(image), "--out", str(out)])

    said = capsys.readouterr()
    assert (status, said.err) == (0, "")
    assert "features as maps of the image" in said.out
    assert "--features" in said.out
    drawn = cv2.imread(str(out)).astype(int)
    assert (drawn[..., 1] - drawn[..., 2] > 100).any()  # green marks on a grey image


def test_what_is_wrong_is_one_line_and_nothing_is_drawn(
    tmp_path: Path, image: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    boxes = write_graph(tmp_path / "m.onnx", {"output0": np.zeros((1, 84, 84), np.float32)})
    out = tmp_path / "masks.png"

    status = main(["model", "check", str(boxes), str(image), "--out", str(out)])

    said = capsys.readouterr().err
    assert status == 2
    assert said.count("\n") == 1
    assert "it finds boxes only, no masks" in said
    assert "output0 float32 [1,84,84]" in said
    assert not out.exists()


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["{image}", "--out", "{folder}/none/x.png"], "is no folder"),
        (["--out", "{folder}/x.jpg"], "give an IMAGE"),
        (["--out", "{folder}/x.png"], "give an IMAGE"),
        (["{folder}/no.png"], "is missing"),
    ],
)
def test_wrong_use_is_said_before_the_model_is_tried(
    arguments: list[str],
    said: str,
    tmp_path: Path,
    image: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    filled = [text.format(image=image, folder=tmp_path) for text in arguments]

    assert main(["model", "check", str(tmp_path / "no.onnx"), *filled]) == 2

    err = capsys.readouterr().err
    assert err.count("\n") == 1
    assert re.search(said, err)


def test_a_model_that_ends_its_process_is_said(tmp_path: Path) -> None:
    process = SegmenterProcess(
        tmp_path / "m.onnx", (8, 8), model_commands.SegmenterConfig(), child=("/bin/false",)
    )
    while process.status.state == "starting":
        process.poll(0.2)

    with pytest.raises(ModelRefused, match=r"ended \(status 1\); it would be started again"):
        model_commands._check_alive(tmp_path / "m.onnx", process)
    process.close()
