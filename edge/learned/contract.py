# SPDX-License-Identifier: Apache-2.0
"""What a model of features asks for and gives, told by shapes alone."""

from collections.abc import Mapping, Sequence
from typing import Any, Literal, NamedTuple, NoReturn

from numpy.typing import NDArray

from edge.errors import ModelRefused
from edge.onnx.tensor import Tensor, tensors

Arrays = Mapping[str, NDArray[Any]]
CELL_PX = 8  # side of the cells of key point logits
_CELL_CHANNELS = CELL_PX * CELL_PX + 1  # a pixel each, and one for none of them
_MIN_DIMENSIONS = 16
_MAX_DIMENSIONS = 1024
_MIN_POINTS = 16  # of a picture full of corners: fewer do not tell what an axis is
_MULTIPLE_PX = 32  # networks halve an image up to five times


class InputForm(NamedTuple):
    """The image that a model takes: grey or three equal channels, 0 to 1."""

    name: str
    channels: int
    width: int  # 0: any
    height: int

    def size_for(self, width: int, height: int) -> tuple[int, int]:
        """Width and height that an image is resized to."""
        whole = (max(side // _MULTIPLE_PX, 1) * _MULTIPLE_PX for side in (width, height))
        free_width, free_height = whole
        return self.width or free_width, self.height or free_height


class OutputForm(NamedTuple):
    """Names of the outputs by what they are."""

    kind: Literal["maps", "points"]
    places: str  # maps: logits of cells or a heat map; points: their pixels
    descriptors: str
    worth: str | None  # maps: reliability; points: scores
    dimensions: int  # of a descriptor


def settle_input(inputs: Sequence[Tensor]) -> InputForm:
    """The input's form; ModelRefused where it is no single image."""
    told = ", ".join(map(str, inputs)) or "none"
    if len(inputs) != 1:
        raise ModelRefused(f"it has {len(inputs)} inputs, not one image; inputs: {told}")
    (tensor,) = inputs
    if tensor.dtype != "float32" or len(tensor.shape) != 4 or tensor.shape[1] not in (-1, 1, 3):
        raise ModelRefused(f"its input is no image of float32 [1,1 or 3,h,w]; inputs: {told}")
    if tensor.shape[0] not in (-1, 1):
        raise ModelRefused(f"it takes several images at once, not one; inputs: {told}")
    sides = [max(side, 0) for side in tensor.shape[2:]]
    if any(0 < side < _MULTIPLE_PX for side in sides):
        raise ModelRefused(f"its input is smaller than {_MULTIPLE_PX} pixels; inputs: {told}")
    return InputForm(tensor.name, max(tensor.shape[1], 1), sides[1], sides[0])


def recognise(outputs: Arrays, width: int, height: int) -> OutputForm:
    """What the outputs for an image of this size are; ModelRefused, with all shapes, if unsure."""
    if any(array.dtype.kind not in "fiu" for array in outputs.values()):
        _refuse("an output is no array of numbers", outputs)
    if all(array.ndim == 4 for array in outputs.values()):
        return _maps(outputs, width, height)
    return _points(outputs)


def _maps(outputs: Arrays, width: int, height: int) -> OutputForm:
    places, descriptors, worth = [], [], []
    for name, array in outputs.items():
        batch, channels, h, w = array.shape
        if batch != 1 or h > height or w > width:
            _refuse("its maps do not fit the image", outputs)
        cells = (h * CELL_PX, w * CELL_PX) == (height, width)
        if (channels == _CELL_CHANNELS and cells) or (channels == 1 and (h, w) == (height, width)):
            places.append(name)
        elif channels == 1:
            worth.append(name)
        elif _MIN_DIMENSIONS <= channels <= _MAX_DIMENSIONS:
            descriptors.append(name)
        else:
            _refuse(f"{name} is neither key points nor descriptors", outputs)
    if len(places) != 1 or len(descriptors) != 1 or len(worth) > 1:
        _refuse("one map of key points and one of descriptors are needed", outputs)
    dimensions = outputs[descriptors[0]].shape[1]
    return OutputForm("maps", places[0], descriptors[0], worth[0] if worth else None, dimensions)


def _points(outputs: Arrays) -> OutputForm:
    flat = {name: without_batch(array) for name, array in outputs.items()}
    pairs = [n for n, a in flat.items() if a.ndim == 2 and a.shape[1] == 2]
    if len(pairs) != 1:
        _refuse("one list of key points [n,2] is needed", outputs)
    points = flat[pairs[0]]
    count = len(points)
    if count < _MIN_POINTS:
        _refuse(f"it finds {count} key points in a picture full of corners", outputs)
    if abs(points).max() <= 1.0:
        _refuse("its key points are not in pixels: export them so", outputs)
    described = [
        n for n, a in flat.items()
        if a.ndim == 2 and len(a) == count and _MIN_DIMENSIONS <= a.shape[1] <= _MAX_DIMENSIONS
    ]  # fmt: skip
    scores = [n for n, a in flat.items() if a.shape in ((count,), (count, 1))]
    if len(described) != 1 or len(scores) > 1 or len(outputs) != 2 + len(scores):
        _refuse("key points [n,2], descriptors [n,d] and at most scores [n] are needed", outputs)
    dimensions = flat[described[0]].shape[1]
    return OutputForm("points", pairs[0], described[0], scores[0] if scores else None, dimensions)


def without_batch(array: NDArray[Any]) -> NDArray[Any]:
    """An array without a first axis of one image."""
    return array[0] if array.ndim in (2, 3) and array.shape[0] == 1 else array


def _refuse(why: str, outputs: Arrays) -> NoReturn:
    told = ", ".join(map(str, tensors(outputs))) or "none"
    raise ModelRefused(f"{why}; outputs: {told} (edge/learned/FEATURES.md)")
