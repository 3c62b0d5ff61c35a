# SPDX-License-Identifier: Apache-2.0
"""ONNX graphs that say a fixed scene in the exact output form of each convention.

The scene: an image of 128x64 with two objects. Each has a box that reaches beyond its mask, which
is a rectangle of whole prototype cells; edges are in the image's own pixels: i from i to i + 1.
"""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

IMAGE_SIZE = (128, 64)
SIDE = 64  # of the input
CELLS = 84  # of the grids of 64x64 at strides 8, 16, 32
N_PROTOTYPES = 8
CLASSES = ("cup", "chair", "book")
FLOATS = {np.dtype("f4"): TensorProto.FLOAT, np.dtype("f2"): TensorProto.FLOAT16}

Array = NDArray[Any]


class Thing(NamedTuple):
    label: int
    score: float
    box: tuple[int, int, int, int]
    mask: tuple[int, int, int, int]


THINGS = (
    Thing(1, 0.9, (24, 8, 80, 56), (32, 16, 72, 48)),
    Thing(2, 0.7, (88, 8, 128, 40), (96, 16, 112, 32)),
)


class Parts(NamedTuple):
    """The scene in the input's pixels, as the fit of a convention lays it out."""

    boxes: Array  # (n, 4)
    masks: Array  # (n, 64, 64) 0 or 1


def parts(fit: str) -> Parts:
    """Both objects, then the first again with a lower score under another name, then a guess."""
    scale = np.array([0.5, 1.0 if fit == "stretch" else 0.5] * 2)
    shift = np.array([0, 16, 0, 16]) if fit == "centre" else np.zeros(4)
    things = (*THINGS, THINGS[0], THINGS[1])
    boxes = np.array([t.box for t in things]) * scale + shift
    masks = np.zeros((len(things), SIDE, SIDE), np.float32)
    for plane, thing in zip(masks, things, strict=True):
        x0, y0, x1, y1 = (np.array(thing.mask) * scale + shift).astype(int)
        plane[y0:y1, x0:x1] = 1.0
    return Parts(boxes.astype(np.float32), masks)


LABELS = (1, 2, 0, 2)
SCORES = (0.9, 0.7, 0.5, 0.04)


def prototypes(masks: Array) -> tuple[Array, Array]:
    """Prototypes (M, 16, 16) and coefficients (n, M) whose product is above 0 on the masks."""
    cells = masks[:2, 2::4, 2::4]
    planes = np.zeros((N_PROTOTYPES, 16, 16), np.float32)
    planes[:2] = 16.0 * cells - 8.0
    coefficients = np.zeros((4, N_PROTOTYPES), np.float32)
    coefficients[[0, 1, 2, 3], [0, 1, 0, 1]] = 1.0
    return planes, coefficients


def write_graph(
    path: Path,
    outputs: Mapping[str, Array],
    *,
    shape: Sequence[int | str] = (1, 3, SIDE, SIDE),
    dtype: int = TensorProto.FLOAT,
    metadata: Mapping[str, str] | None = None,
    opset: int = 17,
    more_inputs: Sequence[str] = (),
    free_outputs: bool = False,
) -> Path:
    """A model that gives these arrays whatever it sees."""
    inputs = [helper.make_tensor_value_info("images", dtype, list(shape))]
    inputs += [helper.make_tensor_value_info(name, TensorProto.FLOAT, [1]) for name in more_inputs]
    nodes, constants, infos = [], [], []
    for name, array in outputs.items():
        constants.append(numpy_helper.from_array(array, f"{name}_value"))
        nodes.append(helper.make_node("Identity", [f"{name}_value"], [name]))
        kind = helper.np_dtype_to_tensor_dtype(array.dtype)
        axes = [f"{name}_{i}" for i in range(array.ndim)] if free_outputs else array.shape
        infos.append(helper.make_tensor_value_info(name, kind, axes))
    graph = helper.make_graph(nodes, "scene", inputs, infos, constants)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", opset)], ir_version=8)
    helper.set_model_props(model, dict(metadata or {}))
    onnx.save(model, path)
    return path


def names(labels: Sequence[str] = CLASSES) -> dict[str, str]:
    return {"names": str(dict(enumerate(labels))), "task": "segment"}


def dense(n_before: int, rows: int, *, fit: str = "centre") -> tuple[Array, Array]:
    """Head (rows, columns) with objects in scattered cells, and prototypes."""
    scene = parts(fit)
    planes, coefficients = prototypes(scene.masks)
    head = np.zeros((rows, n_before + len(CLASSES) + N_PROTOTYPES), np.float32)
    head[:, :4] = (32.0, 32.0, 8.0, 8.0)
    boxes = scene.boxes
    at = [5, 70, 11, 30]
    head[at, 0:2] = 0.5 * (boxes[:, :2] + boxes[:, 2:])
    head[at, 2:4] = boxes[:, 2:] - boxes[:, :2]
    share = 1.0
    if n_before == 5:
        share = 0.95  # of the cell's own score and its class's, both have to be multiplied
        head[at, 4] = share
    head[at, n_before + np.array(LABELS)] = np.array(SCORES) / share
    head[at, -N_PROTOTYPES:] = coefficients
    return head, planes


def write_yolov8(path: Path, **options: Any) -> Path:
    head, planes = dense(4, CELLS)
    outputs = {"output0": np.ascontiguousarray(head.T)[None], "output1": planes[None]}
    return write_graph(path, outputs, **{"metadata": names(), **options})


def write_yolov5(path: Path) -> Path:
    head, planes = dense(5, 3 * CELLS)
    return write_graph(path, {"output0": head[None], "output1": planes[None]}, metadata=names())


def write_end2end(path: Path) -> Path:
    scene = parts("centre")
    planes, coefficients = prototypes(scene.masks)
    head = np.zeros((30, 6 + N_PROTOTYPES), np.float32)
    head[:4] = np.concatenate(
        [scene.boxes, np.array([SCORES, LABELS]).T, coefficients], axis=1, dtype=np.float32
    )
    return write_graph(path, {"output0": head[None], "output1": planes[None]}, metadata=names())


def write_rtmdet(path: Path) -> Path:
    scene = parts("corner")
    dets = np.concatenate([scene.boxes, np.array([SCORES]).T], axis=1, dtype=np.float32)
    outputs = {
        "dets": dets[None],
        "labels": np.array([LABELS], np.int64),
        "masks": scene.masks[None],
    }
    write_sidecar(path, 'names = ["cup", "chair", "book"]')
    return write_graph(path, outputs, free_outputs=True)


def write_maskrcnn(path: Path) -> Path:
    scene = parts("centre")
    outputs = {
        "boxes": scene.boxes,
        "labels": np.array(LABELS, np.int64) + 1,
        "scores": np.array(SCORES, np.float32),
        "masks": scene.masks[:, None],
    }
    write_sidecar(path, 'names = ["background", "cup", "chair", "book"]')
    return write_graph(path, outputs, shape=(3, SIDE, SIDE), free_outputs=True)


def write_yolact(path: Path) -> Path:
    scene = parts("stretch")
    planes, coefficients = prototypes(scene.masks)
    rng = np.random.default_rng(3)
    priors = rng.uniform(0.2, 0.8, (50, 4)).astype(np.float32)
    loc = np.zeros((50, 4), np.float32)
    conf = np.zeros((50, 4), np.float32)
    conf[:, 0] = 1.0
    mask = np.zeros((50, N_PROTOTYPES), np.float32)
    at = [40, 3, 20, 7]
    centre = 0.5 * (scene.boxes[:, :2] + scene.boxes[:, 2:]) / SIDE
    size = (scene.boxes[:, 2:] - scene.boxes[:, :2]) / SIDE
    loc[at, :2] = (centre - priors[at, :2]) / (0.1 * priors[at, 2:])
    loc[at, 2:] = np.log(size / priors[at, 2:]) / 0.2
    conf[at, 1 + np.array(LABELS)] = SCORES
    conf[at, 0] = 1.0 - np.array(SCORES)
    mask[at] = coefficients
    outputs = {
        "boxes": loc[None],
        "conf": conf[None],
        "mask": mask[None],
        "priors": priors,
        "proto": np.ascontiguousarray(planes.transpose(1, 2, 0))[None],
    }
    text = 'convention = "yolact"\nnames = ["cup", "chair", "book"]\n[outputs]\nloc = "boxes"\n'
    write_sidecar(path, text)
    return write_graph(path, outputs)


def write_sidecar(model: Path, text: str) -> None:
    model.with_name(model.name + ".toml").write_text(text)


WRITERS: dict[str, Callable[[Path], Path]] = {
    "yolov8": write_yolov8,
    "yolov5": write_yolov5,
    "end2end": write_end2end,
    "rtmdet": write_rtmdet,
    "maskrcnn": write_maskrcnn,
    "yolact": write_yolact,
}


def write_moody(path: Path) -> Path:
    """The scene as YOLOv8 gives it; a bright red image gives NaN, green hangs, blue eats memory."""
    head, planes = dense(4, CELLS)
    constants = {
        "head": np.ascontiguousarray(head.T)[None],
        "planes": planes[None],
        "limit": np.array(0.9, np.float32),
        "zero": np.array(0.0, np.float32),
        "many": np.array(1e13, np.float32),
        "floats": np.array(5e9, np.float32),
        "one": np.array([1], np.int64),
        "yes": np.array(True),
    }
    float_, bool_, int_ = TensorProto.FLOAT, TensorProto.BOOL, TensorProto.INT64
    body = helper.make_graph(
        [
            helper.make_node("Identity", ["goes_on"], ["goes_on_out"]),
            helper.make_node("Cos", ["state"], ["state_out"]),
        ],
        "body",
        [
            helper.make_tensor_value_info("round", int_, []),
            helper.make_tensor_value_info("goes_on", bool_, []),
            helper.make_tensor_value_info("state", float_, []),
        ],
        [
            helper.make_tensor_value_info("goes_on_out", bool_, []),
            helper.make_tensor_value_info("state_out", float_, []),
        ],
    )
    node = helper.make_node
    nodes = [
        node("ReduceMean", ["images"], ["means"], axes=[0, 2, 3], keepdims=0),
        node("Split", ["means"], ["r1", "g1", "b1"], axis=0),
        *[node("Squeeze", [f"{c}1"], [c]) for c in "rgb"],
        node("Sub", ["limit", "r"], ["room"]),
        node("Sqrt", ["room"], ["root"]),
        *[node("Sub", [c, "limit"], [f"{c}_over"]) for c in "gb"],
        *[node("Relu", [f"{c}_over"], [f"{c}_much"]) for c in "gb"],
        node("Mul", ["g_much", "many"], ["rounds_f"]),
        node("Cast", ["rounds_f"], ["rounds"], to=int_),
        node("Loop", ["rounds", "yes", "zero"], ["spun"], body=body),
        node("Mul", ["b_much", "floats"], ["size_f"]),
        node("Cast", ["size_f"], ["size_0"], to=int_),
        node("Reshape", ["size_0", "one"], ["size"]),
        node("ConstantOfShape", ["size"], ["heap"]),
        node("ReduceSum", ["heap"], ["pile"], keepdims=0),
        node("Sum", ["root", "spun", "pile"], ["mood"]),
        node("Mul", ["mood", "zero"], ["nothing"]),
        node("Add", ["head", "nothing"], ["output0"]),
        node("Identity", ["planes"], ["output1"]),
    ]
    graph = helper.make_graph(
        nodes,
        "moody",
        [helper.make_tensor_value_info("images", float_, [1, 3, SIDE, SIDE])],
        [
            helper.make_tensor_value_info("output0", float_, constants["head"].shape),
            helper.make_tensor_value_info("output1", float_, constants["planes"].shape),
        ],
        [numpy_helper.from_array(value, name) for name, value in constants.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    helper.set_model_props(model, names())
    onnx.checker.check_model(model, full_check=True)
    onnx.save(model, path)
    return path
