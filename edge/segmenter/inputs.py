# SPDX-License-Identifier: Apache-2.0
"""What a model's input is, and pictures in that form."""

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from edge.errors import ModelRefused
from edge.onnx.tensor import Tensor
from edge.segmenter.contract import (
    Channels,
    Colour,
    Convention,
    Fit,
    InputForm,
    Sidecar,
)
from edge.types import U8

_DTYPES: dict[str, Literal["float32", "float16", "uint8"]] = {
    "float32": "float32",
    "float16": "float16",
    "uint8": "uint8",
}
_UNIT: tuple[Colour, Colour] = ((0.0, 0.0, 0.0), (255.0, 255.0, 255.0))
# As the authors trained: MMDetection's mean and deviation stand for blue, green, red, YOLACT's
# too but are given to it as red, green, blue.
_HABITS: dict[Convention, tuple[Channels, Colour, Colour, Fit]] = {
    "yolov8": ("rgb", *_UNIT, "centre"),
    "yolov5": ("rgb", *_UNIT, "centre"),
    "end2end": ("rgb", *_UNIT, "centre"),
    "rtmdet": ("bgr", (103.53, 116.28, 123.675), (57.375, 57.12, 58.395), "corner"),
    "maskrcnn": ("rgb", *_UNIT, "centre"),
    "yolact": ("rgb", (123.68, 116.78, 103.94), (58.40, 57.12, 57.38), "stretch"),
}


def settle_input(
    inputs: Sequence[Tensor],
    sidecar: Sidecar | None,
    said_size: tuple[int, int] | None,
    convention: Convention = "yolov8",
) -> InputForm:
    """The input's form: from the sidecar, else the graph, else metadata and convention."""
    shapes = ", ".join(str(tensor) for tensor in inputs) or "none"
    if len(inputs) != 1:
        raise ModelRefused(f"it has {len(inputs)} inputs, not one image; inputs: {shapes}")
    tensor, sidecar = inputs[0], sidecar or Sidecar()
    if tensor.dtype not in _DTYPES:
        raise ModelRefused(f"its input is of {tensor.dtype}, no image; inputs: {shapes}")
    layout, height, width = _axes(tensor)
    width = _settle_side("width", width, sidecar.width, said_size and said_size[0], shapes)
    height = _settle_side("height", height, sidecar.height, said_size and said_size[1], shapes)
    channels, mean, std, fit = _HABITS[convention]
    return InputForm(
        name=tensor.name,
        dtype=_DTYPES[tensor.dtype],
        layout=layout,
        width=width,
        height=height,
        channels=sidecar.channels or channels,
        mean=sidecar.mean or mean,
        std=sidecar.std or std,
        fit=sidecar.fit or fit,
        pad=114 if sidecar.pad is None else sidecar.pad,
    )


def _axes(tensor: Tensor) -> tuple[Literal["nchw", "nhwc", "chw"], int, int]:
    """Layout, height and width; -1 where they are not fixed."""
    shape = tensor.shape
    if len(shape) == 3 and shape[0] in (3, -1):
        return "chw", shape[1], shape[2]
    if len(shape) == 4 and shape[0] not in (1, -1):
        raise ModelRefused(
            f"it wants {shape[0]} images at once: export it for one; input: {tensor}"
        )
    if len(shape) == 4 and shape[3] == 3 and shape[1] != 3:
        return "nhwc", shape[1], shape[2]
    if len(shape) == 4 and shape[1] in (3, -1):
        return "nchw", shape[2], shape[3]
    raise ModelRefused(f"its input is no colour image; input: {tensor}")


def _settle_side(key: str, fixed: int, told: int | None, said: int | None, shapes: str) -> int:
    if fixed > 0 and told not in (None, fixed):
        raise ModelRefused(f"its sidecar says {key} = {told}, its graph {fixed}; inputs: {shapes}")
    side = fixed if fixed > 0 else told or said
    if side is None:
        why = f"its input has no fixed {key}: give width and height in MODEL.onnx.toml"
        raise ModelRefused(f"{why}; inputs: {shapes}")
    if not 32 <= side <= 4096:
        raise ModelRefused(f"its input's {key} is {side}, no image's; inputs: {shapes}")
    return side


def to_tensor(picture: U8, form: InputForm) -> NDArray[Any]:
    """Input array of a picture (H, W, 3) uint8, red first."""
    if form.channels == "bgr":
        picture = picture[:, :, ::-1]
    if form.dtype == "uint8":
        values: NDArray[Any] = picture
    else:
        mean, std = (np.array(c, dtype=np.float32) for c in (form.mean, form.std))
        values = ((picture.astype(np.float32) - mean) / std).astype(form.dtype)
    if form.layout != "nhwc":
        values = values.transpose(2, 0, 1)
    return np.ascontiguousarray(values if form.layout == "chw" else values[None])
