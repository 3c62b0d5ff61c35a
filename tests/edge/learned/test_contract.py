# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from edge.errors import ModelRefused
from edge.learned.contract import recognise, settle_input
from edge.onnx.tensor import Tensor

WIDTH, HEIGHT = 320, 256


def given(**shapes: tuple[int, ...]) -> dict[str, np.ndarray]:
    return {name: np.full(shape, 2.0, np.float32) for name, shape in shapes.items()}


@pytest.mark.parametrize(
    ("outputs", "places", "dimensions", "worth"),
    [
        (given(a=(1, 64, 32, 40), b=(1, 65, 32, 40), c=(1, 1, 32, 40)), "b", 64, "c"),
        (given(semi=(1, 65, 32, 40), desc=(1, 256, 32, 40)), "semi", 256, None),
        (given(heat=(1, 1, 256, 320), desc=(1, 128, 256, 320)), "heat", 128, None),
        (given(k=(1, 100, 2), d=(1, 100, 64), s=(1, 100)), "k", 64, "s"),
        (given(k=(100, 2), d=(100, 256)), "k", 256, None),
    ],
    ids=["reliable cells", "cells", "heat", "lists of a batch", "lists"],
)
def test_shapes_tell_what_outputs_are(
    outputs: dict[str, np.ndarray], places: str, dimensions: int, worth: str | None
) -> None:
    form = recognise(outputs, WIDTH, HEIGHT)
    assert (form.places, form.dimensions, form.worth) == (places, dimensions, worth)
    assert form.kind == ("points" if "k" in outputs else "maps")


@pytest.mark.parametrize(
    ("outputs", "why"),
    [
        (given(logits=(1, 1000)), "one list of key points"),
        (given(boxes=(1, 116, 2100), masks=(1, 32, 64, 80)), "one list of key points"),
        (given(semi=(1, 65, 32, 40)), "one map of key points and one of descriptors"),
        (given(a=(1, 64, 32, 40), b=(1, 128, 32, 40)), "one map of key points"),
        (given(a=(1, 3, 256, 320), b=(1, 65, 32, 40)), "a is neither"),
        (given(a=(1, 64, 512, 640), b=(1, 65, 32, 40)), "do not fit the image"),
        (given(k=(100, 2), d=(90, 64)), "descriptors \\[n,d\\]"),
        (given(k=(3, 2), d=(3, 64)), "finds 3 key points"),
        ({"k": np.zeros((100, 2)), "d": np.ones((100, 64))}, "not in pixels"),
    ],
)
def test_what_is_unsure_is_refused_with_its_shapes(
    outputs: dict[str, np.ndarray], why: str
) -> None:
    with pytest.raises(ModelRefused, match=why) as refused:
        recognise(outputs, WIDTH, HEIGHT)
    told = str(refused.value)
    assert "\n" not in told
    for name, array in outputs.items():
        assert f"{name} {array.dtype} [{','.join(map(str, array.shape))}]" in told


def test_open_sides_take_the_image_and_fixed_ones_do_not() -> None:
    free = settle_input([Tensor("x", "float32", (1, 1, -1, -1))])
    assert free.size_for(1241, 376) == (1216, 352)
    fixed = settle_input([Tensor("x", "float32", (-1, 3, 240, 320))])
    assert (fixed.size_for(1241, 376), fixed.channels) == ((320, 240), 3)


@pytest.mark.parametrize(
    "inputs",
    [
        [],
        [Tensor("x", "float32", (1, 1, -1, -1)), Tensor("size", "int64", (2,))],
        [Tensor("x", "uint8", (1, 1, -1, -1))],
        [Tensor("x", "float32", (1, 4, 64, 64))],
        [Tensor("x", "float32", (2, 1, 64, 64))],
        [Tensor("x", "float32", (1, 1, 8, 8))],
    ],
)
def test_what_is_no_single_image_is_refused(inputs: list[Tensor]) -> None:
    with pytest.raises(ModelRefused, match="inputs: "):
        settle_input(inputs)
