# SPDX-License-Identifier: Apache-2.0
from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper

from edge.errors import ModelRefused
from edge.learned.model import LearnedModel
from edge.learned.picture import picture
from tools.corner_model import make

WIDTH, HEIGHT = 320, 224


@pytest.fixture(scope="module")
def corners(tmp_path_factory: pytest.TempPathFactory) -> LearnedModel:
    return LearnedModel(make(tmp_path_factory.mktemp("model") / "corners.onnx"))


def differing(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.unpackbits(a[:, None] ^ b[None], axis=2).sum(axis=2)


def test_moved_corners_are_found_and_known_again(corners: LearnedModel) -> None:
    scene = picture(WIDTH + 32, HEIGHT + 32)
    first, second = scene[:HEIGHT, :WIDTH], scene[8 : HEIGHT + 8, 12 : WIDTH + 12]
    a, b = (corners.find(np.ascontiguousarray(image), 300) for image in (first, second))
    distance = differing(corners.codes(a), corners.codes(b))
    nearest = distance.argmin(axis=1)
    off = a.pixels - b.pixels[nearest] - (12.0, 8.0)
    good = np.linalg.norm(off, axis=1) < 1.5
    assert good.mean() > 0.6
    assert np.median(distance) > 90
    assert np.median(distance.min(axis=1)[good]) < 30


def test_an_image_of_another_size_is_told_in_its_own_pixels(corners: LearnedModel) -> None:
    scene = picture(WIDTH, HEIGHT)
    padded = np.pad(scene, ((0, 20), (0, 20)), mode="edge")  # resized by a fifteenth
    a, b = corners.find(scene, 200), corners.find(padded, 200)
    apart = np.linalg.norm(a.pixels[:, None] - b.pixels[None], axis=2).min(axis=1)
    assert np.median(apart) < 1.5


def test_lists_say_the_same_as_maps(corners: LearnedModel, tmp_path: Path) -> None:
    listed = LearnedModel(make(tmp_path / "m.onnx", points=(400, WIDTH, HEIGHT)))
    scene = picture(WIDTH, HEIGHT)
    a, b = corners.find(scene, 200), listed.find(scene, 200)
    apart = np.linalg.norm(a.pixels[:, None] - b.pixels[None], axis=2)
    assert np.mean(apart.min(axis=1) < 1.0) > 0.9  # those are whole pixels
    assert len(listed.find(np.zeros((HEIGHT, WIDTH), np.uint8), 200).pixels) == 0
    half = listed.find(np.ascontiguousarray(scene[::2, ::2]), 200)
    assert half.pixels.max(axis=0) == pytest.approx((WIDTH / 2, HEIGHT / 2), abs=12)


def test_a_single_key_point_is_one(tmp_path: Path) -> None:
    listed = LearnedModel(make(tmp_path / "m.onnx", points=(400, WIDTH, HEIGHT)))
    one = {
        "keypoints": np.array([[30.0, 40.0]], np.float32),
        "descriptors": np.ones((1, 128), np.float32),
        "scores": np.ones(1, np.float32),
    }
    for batch in (False, True):
        given = {name: array[None] if batch else array for name, array in one.items()}
        found = listed._read(given, 10)
        assert found.pixels.tolist() == [[30.0, 40.0]]
        assert found.descriptors.shape == (1, 128)


def simple(path: Path, op: str) -> Path:
    """A graph that gives its input, changed."""
    x = helper.make_tensor_value_info("x", TensorProto.FLOAT, [1, 1, 64, 64])
    y = helper.make_tensor_value_info("y", TensorProto.FLOAT, None)
    graph = helper.make_graph([helper.make_node(op, ["x"], ["y"])], "g", [x], [y])
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=9)
    onnx.save(model, path)
    return path


def test_other_models_are_refused_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(ModelRefused) as refused:
        LearnedModel(simple(tmp_path / "m.onnx", "Neg"))
    assert str(refused.value).startswith(f"{tmp_path / 'm.onnx'}: one map of key points")
    assert "y float32 [1,1,64,64]" in str(refused.value)
    text = tmp_path / "text.onnx"
    text.write_text("no model")
    with pytest.raises(ModelRefused, match="no ONNX file"):
        LearnedModel(text)
