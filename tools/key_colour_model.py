# SPDX-License-Identifier: Apache-2.0
"""Makes a segmentation model for rendered scenes: `python -m tools.key_colour_model OUT.onnx`.

It finds the saturated key colours of our simulated objects, and nothing else can: no training, no
weights from anybody. What it gives is exactly what a YOLOv8-seg model gives, so that all that
stands behind a detector can be tested with a detector whose faults are known: it does not see
behind things, takes two touching objects of one colour for one, and loses the far end of shapes
that wind through more than `FLOOD_STEPS` coarse cells.
"""

import argparse
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

try:
    import onnx
    from onnx import helper, numpy_helper
except ImportError:
    raise SystemExit("tools.key_colour_model needs onnx: `tools/install dev` brings it") from None

from edge.segmenter.recognise import count_cells
from tools.simworld.objects import KEY_COLOURS

N_PROTOTYPES = 32
FINE, COARSE = 4, 8  # pixels of a prototype's cell, and of a cell that may hold an object
FLOOD_STEPS = 48  # coarse cells that a shape may wind through
GAMMA = 2.2  # light adds up before it, so colours are compared before it
# In chromaticity of light: shine and the light of walls move a key colour by less, and other
# surfaces are further away; both were measured on rendered rooms.
NEAR = {"ball": 0.16, "mug": 0.33, "carton": 0.33, "figurine": 0.19}
STEEP = 250.0  # logits for the square of that distance
DARK, STEEP_DARK = 0.02, 400.0  # below this light, colours are noise
SMALL_PX = 12.0  # smaller ones are believed less
FAR = 1e6  # beyond all coordinates and numbers of cells
OPSET = 17


class Graph:
    """Collects nodes; each adds one and returns the name of its output."""

    def __init__(self) -> None:
        self.nodes: list[onnx.NodeProto] = []
        self.constants: list[onnx.TensorProto] = []

    def constant(self, value: Any, dtype: type = np.float32) -> str:
        """Name of a constant."""
        name = f"c{len(self.constants)}"
        self.constants.append(numpy_helper.from_array(np.asarray(value, dtype=dtype), name))
        return name

    def add(self, op: str, *inputs: str, out: str = "", **attributes: Any) -> str:
        """Add one node."""
        name = out or f"n{len(self.nodes)}"
        self.nodes.append(helper.make_node(op, list(inputs), [name], **attributes))
        return name


def orthonormal(rows: int, columns: int) -> NDArray[np.float32]:
    """Columns of a cosine transform: the product with its transpose gives each class back."""
    i, k = np.mgrid[0:rows, 1 : columns + 1]
    matrix = np.sqrt(2.0 / rows) * np.cos(np.pi * (i + 0.5) * k / rows)
    columns_f32: NDArray[np.float32] = matrix.astype(np.float32)
    return columns_f32


def class_logits(g: Graph, image: str) -> str:
    """Logits (1, K, H/4, W/4): above 0 where the colour is that of a class."""
    light = (np.array(list(KEY_COLOURS.values()))[:, ::-1] / 255.0) ** GAMMA
    keys = light / light.sum(axis=1, keepdims=True)
    near_2 = np.array([NEAR[label] for label in KEY_COLOURS]) ** 2
    mean = g.add("AveragePool", image, kernel_shape=[FINE, FINE], strides=[FINE, FINE])
    colour = g.add("Pow", mean, g.constant(GAMMA))
    axis = g.constant([1], np.int64)
    total = g.add("Add", g.add("ReduceSum", colour, axis), g.constant(0.004))
    chroma = g.add("Div", colour, total)
    # STEEP * (near^2 - |chroma - key|^2), multiplied out.
    weights = g.constant(2.0 * STEEP * keys[:, :, None, None])
    bias = g.constant(STEEP * (near_2 - (keys**2).sum(axis=1)))
    square = g.add("ReduceSum", g.add("Mul", chroma, chroma), axis)
    near = g.add(
        "Sub", g.add("Conv", chroma, weights, bias), g.add("Mul", square, g.constant(STEEP))
    )
    most = g.add("ReduceMax", colour, axes=[1])
    bright = g.add("Mul", g.add("Sub", most, g.constant(DARK)), g.constant(STEEP_DARK))
    both = g.add("Min", near, bright)
    return g.add("Clip", both, g.constant(-8.0), g.constant(8.0))


def flood(
    g: Graph, logits: str, width: int, height: int, step: int = COARSE
) -> tuple[list[str], str]:
    """Spread the extremes of each shape over all of it, by steps of one cell of `step` pixels.

    Returns, each (1, K, H/8, W/8): left (negated), right, top (negated), bottom [px], the largest
    number of a cell, and the best logit; and where the cell is the one so numbered.
    """
    zero, nowhere = g.constant(0.0), g.constant(-FAR)
    is_on = g.add("Greater", logits, zero)
    x = np.arange(0, width, FINE, dtype=np.float32)[None, None, None, :]
    y = np.arange(0, height, FINE, dtype=np.float32)[None, None, :, None]
    planes = [
        g.add("Where", is_on, g.constant(edge), nowhere) for edge in (-x, x + FINE, -y, y + FINE)
    ]
    best = logits
    if step == COARSE:
        planes, best = [_pooled(g, plane) for plane in planes], _pooled(g, best)
    winner = g.add("ReduceMax", best, axes=[1])
    # A cell belongs to one class only.
    owned = g.add("And", g.add("Greater", best, zero), g.add("GreaterOrEqual", best, winner))
    shape = (1, 1, height // step, width // step)
    number = g.constant(1.0 + np.arange(shape[2] * shape[3]).reshape(shape))
    planes += [g.add("Where", owned, number, nowhere), best]
    cap = g.add("Where", owned, g.constant(FAR), nowhere)
    caps = g.add("Concat", *[cap] * len(planes), axis=1)
    state = g.add("Min", g.add("Concat", *planes, axis=1), caps)
    for _ in range(FLOOD_STEPS * COARSE // step):
        spread = g.add("MaxPool", state, kernel_shape=[3, 3], strides=[1, 1], pads=[1, 1, 1, 1])
        state = g.add("Min", spread, caps)
    parts = [f"flooded{i}" for i in range(len(planes))]
    sizes = g.constant([len(KEY_COLOURS)] * len(planes), np.int64)
    g.nodes.append(helper.make_node("Split", [state, sizes], parts, axis=1))
    seed = g.add("Equal", parts[4], number)
    if step == COARSE:
        return parts, seed
    ends = [_pooled(g, g.add("Where", seed, part, nowhere)) for part in parts]
    return ends, g.add("Greater", ends[4], zero)


def _pooled(g: Graph, plane: str) -> str:
    """The largest of the fine cells of each coarse one."""
    return g.add("MaxPool", plane, kernel_shape=[2, 2], strides=[2, 2])


def head(g: Graph, parts: list[str], seed: str, mixing: str, n_cells: int) -> None:
    """Put together output0 (1, 4 + K + M, cells): one cell for each shape."""
    zero, half = g.constant(0.0), g.constant(0.5)
    axis = g.constant([1], np.int64)
    low_x, high_x, low_y, high_y, _, best = parts
    edges = [
        g.add("ReduceSum", g.add("Where", seed, part, zero), axis)
        for part in (low_x, high_x, low_y, high_y)
    ]
    columns = []
    for low, high in ((edges[0], edges[1]), (edges[2], edges[3])):
        columns.append(g.add("Mul", g.add("Sub", high, low), half))  # low is negated
    sizes = [g.add("Add", edges[1], edges[0]), g.add("Add", edges[3], edges[2])]
    thin = g.add("Div", g.add("Min", *sizes), g.constant(SMALL_PX))
    trust = g.add("Clip", thin, zero, g.constant(1.0))
    sure = g.add("Mul", g.add("Sigmoid", g.add("Mul", best, half)), trust)
    scores = g.add("Where", seed, sure, zero)
    hot = g.add("Where", seed, g.constant(1.0), zero)
    coefficients = g.add("Conv", hot, mixing)
    together = g.add("Concat", *columns, *sizes, scores, coefficients, axis=1)
    n_columns = 4 + len(KEY_COLOURS) + N_PROTOTYPES
    flat = g.add("Reshape", together, g.constant([1, n_columns, -1], np.int64))
    # The coarser grids hold nothing.
    empty = g.constant(np.zeros((1, n_columns, n_cells)))
    g.add("Concat", flat, empty, axis=2, out="output0")


def make_model(width: int = 320, height: int = 320, step: int = COARSE) -> onnx.ModelProto:
    """The model, for images of this size (multiples of 32).

    By steps of FINE it parts what is a fine cell apart, as trained models do, at six times the
    cost; by those of COARSE what is two to four of them.
    """
    g = Graph()
    logits = class_logits(g, "images")
    n_classes = len(KEY_COLOURS)
    mixing = g.constant(orthonormal(N_PROTOTYPES, n_classes)[:, :, None, None])
    g.add("Conv", logits, mixing, out="output1")
    parts, seed = flood(g, logits, width, height, step)
    cells = count_cells(width, height)
    head(g, parts, seed, mixing, cells - (width // COARSE) * (height // COARSE))
    kind = onnx.TensorProto.FLOAT
    n_columns = 4 + n_classes + N_PROTOTYPES
    fine = [1, N_PROTOTYPES, height // FINE, width // FINE]
    graph = helper.make_graph(
        g.nodes,
        "key_colours",
        [helper.make_tensor_value_info("images", kind, [1, 3, height, width])],
        [
            helper.make_tensor_value_info("output0", kind, [1, n_columns, cells]),
            helper.make_tensor_value_info("output1", kind, fine),
        ],
        g.constants,
    )
    opset = helper.make_opsetid("", OPSET)
    model = helper.make_model(graph, opset_imports=[opset], ir_version=8)
    said = {"names": str(dict(enumerate(KEY_COLOURS))), "imgsz": f"[{height}, {width}]"}
    helper.set_model_props(model, {**said, "task": "segment"})
    onnx.checker.check_model(model, full_check=True)
    return model


def main() -> None:
    """Write the model."""
    parser = argparse.ArgumentParser(description="Make a model that finds our key colours.")
    parser.add_argument("out", type=Path, metavar="OUT.onnx")
    parser.add_argument("--size", type=int, default=320, help="of its input, a multiple of 32")
    args = parser.parse_args()
    if args.size % 32 or args.size < 32:
        parser.error(f"--size {args.size} is no multiple of 32")
    model = make_model(args.size, args.size)
    onnx.save(model, args.out)
    print(f"{args.out}: {len(model.graph.node)} nodes, {args.out.stat().st_size} bytes")


if __name__ == "__main__":
    main()
