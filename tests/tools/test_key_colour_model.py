# SPDX-License-Identifier: Apache-2.0
from pathlib import Path

import cv2
import numpy as np
import onnx
import pytest

from edge.config.segmenter import SegmenterConfig
from edge.segmenter.model import Model
from tools.key_colour_model import COARSE, FINE, make_model
from tools.simworld.objects import KEY_COLOURS

WIDTH, HEIGHT = 320, 240


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Model:
    path = tmp_path_factory.mktemp("model") / "key.onnx"
    onnx.save(make_model(), path)
    return Model(path, SegmenterConfig())


def grey_scene() -> np.ndarray:
    shade = np.linspace(60, 200, WIDTH, dtype=np.uint8)
    return np.repeat(np.tile(shade, (HEIGHT, 1))[:, :, None], 3, axis=2)


def rgb(label: str, light: float = 1.0) -> tuple[float, ...]:
    return tuple(channel * light for channel in KEY_COLOURS[label][::-1])


def test_it_is_taken_for_what_it_imitates(model: Model) -> None:
    contract = model.contract

    assert contract.output.convention == "yolov8"
    assert contract.output.columns_first
    assert contract.names == tuple(KEY_COLOURS)
    assert not contract.warnings


@pytest.mark.parametrize("light", [1.0, 0.5])
@pytest.mark.parametrize("label", KEY_COLOURS)
def test_a_thing_of_a_key_colour_is_found_with_its_mask(
    label: str, light: float, model: Model
) -> None:
    image, truth = grey_scene(), np.zeros((HEIGHT, WIDTH), np.uint8)
    cv2.ellipse(image, (200, 90), (50, 30), 25, 0, 360, rgb(label, light), -1)
    cv2.ellipse(truth, (200, 90), (50, 30), 25, 0, 360, 1, -1)

    seen = model.segment(image)

    assert [model.contract.names[c] for c in seen.classes] == [label]
    mask = seen.masks[0]
    found = np.zeros((HEIGHT, WIDTH), dtype=bool)
    h, w = mask.inside.shape
    found[mask.top : mask.top + h, mask.left : mask.left + w] = mask.inside
    both, either = (found & (truth > 0)).sum(), (found | (truth > 0)).sum()
    assert both / either > 0.9  # cells are 4 px
    rows, columns = np.nonzero(truth)
    edges = [columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]
    np.testing.assert_allclose(seen.boxes[0], np.array(edges) - 0.5, atol=4.0)


def test_two_of_one_colour_and_one_of_another_are_three(model: Model) -> None:
    image = grey_scene()
    for label, x in (("carton", 20), ("carton", 120), ("ball", 180)):
        cv2.rectangle(image, (x, 60), (x + 39, 139), rgb(label), -1)

    seen = model.segment(image)

    labels = sorted(model.contract.names[c] for c in seen.classes)
    assert labels == ["ball", "carton", "carton"]
    assert sorted(mask.inside.sum() for mask in seen.masks) == pytest.approx([3200] * 3, rel=0.06)


def test_a_bent_shape_is_one_thing(model: Model) -> None:
    image = grey_scene()
    path = np.array([[40, 40], [40, 200], [160, 200], [160, 40], [280, 40]])
    cv2.polylines(image, [path], False, rgb("mug"), 16)

    seen = model.segment(image)

    assert len(seen.masks) == 1
    np.testing.assert_allclose(seen.boxes[0], [31, 31, 288, 208], atol=6.0)


def test_muted_colours_are_nothing(model: Model) -> None:
    rng = np.random.default_rng(2)
    image = grey_scene()
    for _ in range(30):
        x, y = (int(v) for v in rng.integers(0, (WIDTH - 40, HEIGHT - 40)))
        grey = float(rng.uniform(40, 220))
        colour = tuple(float(v) for v in grey * rng.uniform(0.75, 1.15, 3))
        cv2.rectangle(image, (x, y), (x + 39, y + 39), colour, -1)

    assert len(model.segment(image).masks) == 0


def test_the_same_file_comes_out_each_time() -> None:
    assert make_model(96, 64).SerializeToString() == make_model(96, 64).SerializeToString()


def test_other_sizes_work(tmp_path: Path) -> None:
    onnx.save(make_model(160, 96), tmp_path / "key.onnx")
    image = grey_scene()
    cv2.circle(image, (160, 120), 40, rgb("ball"), -1)

    assert len(Model(tmp_path / "key.onnx", SegmenterConfig()).segment(image).masks) == 1


@pytest.mark.parametrize(("width", "step"), [(320, FINE), (640, FINE), (1280, COARSE)])
def test_things_are_found_anywhere_and_parted_by_more_than_a_step(
    width: int, step: int, tmp_path: Path
) -> None:
    onnx.save(make_model(width, 3 * width // 4, step), tmp_path / "key.onnx")
    finer = Model(tmp_path / "key.onnx", SegmenterConfig())
    image = cv2.resize(grey_scene(), (width, 3 * width // 4))
    for left in (16, width - 16 - 40 - 40 - 4 * step):
        for x in (left, left + 40 + 4 * step):
            cv2.rectangle(image, (x, width // 2), (x + 39, width // 2 + 47), rgb("carton"), -1)

    assert len(finer.segment(image).masks) == 4
