# SPDX-License-Identifier: Apache-2.0
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from onnx import TensorProto

from edge.config.segmenter import SegmenterConfig
from edge.errors import EdgeError, ModelRefused
from edge.segmenter.model import Model
from edge.types import Mask
from tests.edge.segmenter.graphs import (
    CELLS,
    CLASSES,
    IMAGE_SIZE,
    SIDE,
    THINGS,
    WRITERS,
    dense,
    names,
    write_graph,
    write_rtmdet,
    write_sidecar,
    write_yolov8,
)

IMAGE = np.zeros((IMAGE_SIZE[1], IMAGE_SIZE[0], 3), np.uint8)


def open_model(path: Path) -> Model:
    return Model(path, SegmenterConfig())


def whole(mask: Mask) -> NDArray[np.bool_]:
    plane = np.zeros((IMAGE_SIZE[1], IMAGE_SIZE[0]), dtype=bool)
    h, w = mask.inside.shape
    plane[mask.top : mask.top + h, mask.left : mask.left + w] = mask.inside
    return plane


@pytest.mark.parametrize("convention", WRITERS)
def test_each_convention_is_recognised_and_read_to_the_pixel(
    convention: str, tmp_path: Path
) -> None:
    model = open_model(WRITERS[convention](tmp_path / "model.onnx"))

    seen = model.segment(IMAGE)

    assert model.contract.output.convention == convention
    # The same object under another name, and one below the least score, are not there.
    assert [model.contract.names[c] for c in seen.classes] == ["chair", "book"]
    np.testing.assert_allclose(seen.scores, [t.score for t in THINGS], rtol=1e-6)
    # Pixel i reaches from i - 0.5 here.
    np.testing.assert_allclose(seen.boxes, np.array([t.box for t in THINGS]) - 0.5, atol=1e-3)
    for mask, thing in zip(seen.masks, THINGS, strict=True):
        x0, y0, x1, y1 = thing.mask
        truth = np.zeros((IMAGE_SIZE[1], IMAGE_SIZE[0]), dtype=bool)
        truth[y0:y1, x0:x1] = True
        # Between prototypes a mask is bilinear, which rounds corners; its sides are exact.
        rows, columns = np.nonzero(whole(mask) != truth)
        corner_px = {"rtmdet": 0, "maskrcnn": 0}.get(convention, 4)
        assert (np.minimum(abs(rows - y0), abs(rows - y1 + 1)) < corner_px).all()
        assert (np.minimum(abs(columns - x0), abs(columns - x1 + 1)) < corner_px).all()
        assert len(rows) <= 4 * 6
        assert mask.inside.size <= (thing.box[2] - thing.box[0]) * (thing.box[3] - thing.box[1])


def test_a_grey_image_is_taken_too(tmp_path: Path) -> None:
    model = open_model(write_yolov8(tmp_path / "model.onnx"))

    assert len(model.segment(IMAGE[:, :, 0]).masks) == len(THINGS)


def test_free_axes_are_settled_by_the_size_in_the_metadata(tmp_path: Path) -> None:
    said = {**names(), "imgsz": f"[{SIDE}, {SIDE}]"}
    free = ("batch", 3, "height", "width")
    path = write_yolov8(tmp_path / "m.onnx", shape=free, metadata=said, free_outputs=True)

    model = open_model(path)

    assert (model.contract.input.width, model.contract.input.height) == (SIDE, SIDE)
    assert model.contract.output.convention == "yolov8"


def test_without_names_the_number_of_cells_tells_and_classes_are_numbered(tmp_path: Path) -> None:
    model = open_model(write_yolov8(tmp_path / "m.onnx", metadata={}))

    assert model.contract.names == ("class 0", "class 1", "class 2")
    assert any("names no classes" in warning for warning in model.contract.warnings)


@pytest.mark.parametrize("text", ['{"0": "cup", "1": "chair", "2": "book"}', str([*CLASSES])])
def test_names_come_as_a_list_and_as_json_too(text: str, tmp_path: Path) -> None:
    model = open_model(write_yolov8(tmp_path / "m.onnx", metadata={"names": text}))

    assert model.contract.names == CLASSES


@pytest.mark.parametrize(
    "options",
    [
        {"shape": ("batch", 3, SIDE, SIDE)},
        {"shape": (1, SIDE, SIDE, 3)},
        {"dtype": TensorProto.FLOAT16},
        {"dtype": TensorProto.UINT8},
    ],
    ids=["any batch", "channels last", "16-bit", "bytes"],
)
def test_other_forms_of_the_input_are_fed_as_they_are(
    options: dict[str, object], tmp_path: Path
) -> None:
    model = open_model(write_yolov8(tmp_path / "m.onnx", **options))

    assert len(model.segment(IMAGE).masks) == len(THINGS)


def test_grids_of_an_input_that_is_not_square_are_counted(tmp_path: Path) -> None:
    head, _ = dense(4, 12 * 8 + 6 * 4 + 3 * 2)
    outputs = {"output0": head.T[None].copy(), "output1": np.zeros((1, 8, 16, 24), np.float32)}

    model = open_model(
        write_graph(tmp_path / "m.onnx", outputs, shape=(1, 3, 64, 96), metadata=names())
    )

    assert model.contract.output.convention == "yolov8"
    assert model.contract.output.columns_first


def test_rows_before_columns_are_read_the_same(tmp_path: Path) -> None:
    head, planes = dense(4, CELLS)
    outputs = {"output0": head[None], "output1": planes[None]}
    path = write_graph(tmp_path / "m.onnx", outputs, metadata=names())

    model = open_model(path)

    assert model.contract.output.convention == "yolov8"
    assert len(model.segment(IMAGE).masks) == len(THINGS)


def test_images_reach_the_model_as_it_was_trained(tmp_path: Path) -> None:
    from edge.segmenter.inputs import to_tensor

    picture = np.zeros((SIDE, SIDE, 3), np.uint8)
    picture[:] = (255, 51, 0)
    yolo = open_model(write_yolov8(tmp_path / "a.onnx")).contract.input
    rtmdet = open_model(write_rtmdet(tmp_path / "b.onnx")).contract.input

    np.testing.assert_allclose(to_tensor(picture, yolo)[0, :, 0, 0], [1.0, 0.2, 0.0])
    expected = [(0 - 103.53) / 57.375, (51 - 116.28) / 57.12, (255 - 123.675) / 58.395]
    np.testing.assert_allclose(to_tensor(picture, rtmdet)[0, :, 0, 0], expected, rtol=1e-6)


def test_slow_kinds_of_numbers_are_warned_of(tmp_path: Path) -> None:
    half = write_yolov8(tmp_path / "m.onnx", dtype=TensorProto.FLOAT16)

    assert any("16-bit" in warning for warning in open_model(half).contract.warnings)
    assert not open_model(write_yolov8(tmp_path / "n.onnx")).contract.warnings


def _spoil(tmp_path: Path, what: str) -> Path:
    """A model that must not be used, for the reason that `what` names."""
    path = tmp_path / "model.onnx"
    head, planes = dense(4, CELLS)
    outputs = {"output0": np.ascontiguousarray(head.T)[None], "output1": planes[None]}
    if what == "nan":
        outputs["output0"][0, 0, 17] = np.nan
    if what == "logits":
        outputs["output0"][0, 5, 17] = 4.0
    if what == "boxes only":
        del outputs["output1"]
    if what == "other grid":
        outputs["output0"] = outputs["output0"][:, :, :-1]
    options: dict[str, dict[str, object]] = {
        "detect": {"metadata": {**names(), "task": "detect"}},
        "too many names": {"metadata": names([*"abcd"])},
        "too few names": {"metadata": names([*"ab"])},
        "evil names": {"metadata": {"names": "__import__('os').abort()"}},
        "deep names": {"metadata": {"names": "[" * 5000}},
        "gaps": {"metadata": {"names": "{0: 'a', 2: 'b', 3: 'c'}"}},
        "batch": {"shape": (4, 3, SIDE, SIDE)},
        "two inputs": {"more_inputs": ("size",)},
        "free": {"shape": ("b", 3, "h", "w")},
        "opset": {"opset": 99},
        "grey": {"shape": (1, 1, SIDE, SIDE)},
    }
    write_graph(path, outputs, **{"metadata": names(), **options.get(what, {})})  # type: ignore[arg-type]
    if what == "cut":
        path.write_bytes(path.read_bytes()[:-100])
    if what == "text":
        path.write_text("no model\n")
    if what == "sidecar":
        write_sidecar(path, 'conventions = "yolov8"')
    if what == "other convention":
        write_sidecar(path, 'convention = "rtmdet"')
    return path


@pytest.mark.parametrize(
    ("what", "said"),
    [
        ("nan", "output0 holds NaN"),
        ("logits", "0 to 4, not 0 to 1"),
        ("boxes only", r"no masks.*output0 float32 \[1,15,84\]"),
        ("other grid", r"84 or 252.*output0 float32 \[1,15,83\]"),
        ("detect", "task 'detect'"),
        ("too many names", r"4 names of classes, but its outputs are for 3.*\[1,15,84\]"),
        ("too few names", r"2 names of classes, but its outputs are for 3.*\[1,15,84\]"),
        ("evil names", "`names` cannot be read"),
        ("deep names", "`names` cannot be read"),
        ("gaps", "does not number the classes"),
        ("batch", "4 images at once"),
        ("two inputs", "2 inputs"),
        ("free", r"width and height in model\.onnx\.toml.*images float32 \[\?,3,\?,\?\]"),
        ("opset", "needs opset 99"),
        ("grey", r"no colour image.*\[1,1,64,64\]"),
        ("cut", "no ONNX file, or cut off"),
        ("text", "no ONNX file"),
        ("sidecar", "unknown key conventions; did you mean convention"),
        ("other convention", "says rtmdet, but its outputs are those of yolov8"),
    ],
)
def test_what_cannot_be_used_is_refused_in_one_line(what: str, said: str, tmp_path: Path) -> None:
    with pytest.raises(EdgeError, match=said) as refusal:
        open_model(_spoil(tmp_path, what))

    assert "\n" not in str(refusal.value)
    assert "model.onnx" in str(refusal.value)


def test_a_class_beyond_the_names_is_refused_when_it_comes(tmp_path: Path) -> None:
    path = write_rtmdet(tmp_path / "model.onnx")
    write_sidecar(path, 'names = ["cup", "chair"]')

    with pytest.raises(ModelRefused, match="gives class 2, but 2 are named"):
        open_model(path)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(ModelRefused, match=r"none\.onnx: cannot be read: No such file"):
        open_model(tmp_path / "none.onnx")
