# SPDX-License-Identifier: Apache-2.0
"""Makes a feature model: `python -m tools.corner_model OUT.onnx [--points COUNT]`.

Harris corners and histograms of gradients around them, written as convolutions: no training, no
weights from anybody, and worse than a trained model. What it gives has the form of one, so that
all that stands behind learned features can be tried with features whose working is known. With
`--points` it picks its corners itself and gives lists, as models do that were exported whole.
"""

import argparse
from pathlib import Path

import numpy as np
import onnx
from onnx import helper

from edge.types import F64
from tools.key_colour_model import Graph

OPSET = 18
DIRECTIONS = 8
CELLS = 4  # of a descriptor, each way
STRIDE = 4  # pixels between places of the descriptor map
CELL_PX = 8
PEAK_PX = 5
EDGE = 0.05  # Harris: how much a second direction counts


def gaussian(sigma: float, radius: int) -> F64:
    """A bell (2 radius + 1, 2 radius + 1) of sum 1."""
    row = np.exp(-0.5 * (np.arange(-radius, radius + 1) / sigma) ** 2)
    bell: F64 = np.outer(row, row) / row.sum() ** 2
    return bell


def smoothed(g: Graph, image: str, kernel: F64, channels: int, stride: int = 1) -> str:
    """Each channel by itself, its border repeated."""
    before, after = len(kernel) // 2, (len(kernel) - 1) // 2
    pads = g.constant([0, 0, before, before, 0, 0, after, after], np.int64)
    padded = g.add("Pad", image, pads, mode="edge")
    weights = g.constant(np.repeat(kernel[None, None], channels, axis=0))
    return g.add("Conv", padded, weights, group=channels, strides=[stride, stride])


def gradients(g: Graph, image: str) -> tuple[str, str]:
    """Slopes (1, 1, h, w) along u and v."""
    smooth = smoothed(g, image, gaussian(1.0, 2), 1)
    along_u = np.zeros((3, 3))
    along_u[1] = (-0.5, 0.0, 0.5)
    return smoothed(g, smooth, along_u, 1), smoothed(g, smooth, along_u.T.copy(), 1)


def corners(g: Graph, du: str, dv: str) -> str:
    """Heat (1, 1, h, w): high where the image changes both ways."""
    bell = gaussian(1.5, 4)
    uu, vv, uv = (
        smoothed(g, g.add("Mul", a, b), bell, 1) for a, b in ((du, du), (dv, dv), (du, dv))
    )
    trace = g.add("Add", uu, vv)
    determinant = g.add("Sub", g.add("Mul", uu, vv), g.add("Mul", uv, uv))
    edge = g.add("Mul", g.add("Mul", trace, trace), g.constant(EDGE))
    return g.add("Relu", g.add("Sub", determinant, edge), out="heat")


def histograms(g: Graph, du: str, dv: str, out: str) -> str:
    """Descriptors (1, 128, h / 4, w / 4): slopes by direction in 4 x 4 cells around each place."""
    angles = 2.0 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS
    weights = np.stack((np.cos(angles), np.sin(angles)), axis=1)[:, :, None, None]
    both = g.add("Concat", du, dv, axis=1)
    strengths = g.add("Relu", g.add("Conv", both, g.constant(weights)))
    # A place of the map lies amid its STRIDE pixels, as the kernel of even length does.
    row = np.exp(-0.5 * ((np.arange(4 * CELL_PX) - 2 * CELL_PX + 0.5) / (0.5 * CELL_PX)) ** 2)
    kernel = np.outer(row, row) / row.sum() ** 2
    pads = 2 * CELL_PX - STRIDE // 2
    around = g.constant([0, 0, pads, pads, 0, 0, pads, pads], np.int64)
    padded = g.add("Pad", strengths, around, mode="edge")
    bells = g.constant(np.repeat(kernel[None, None], DIRECTIONS, axis=0))
    pooled = g.add("Conv", padded, bells, group=DIRECTIONS, strides=[STRIDE, STRIDE])
    step = CELL_PX // STRIDE
    span = step * (CELLS - 1)
    picks = np.zeros((DIRECTIONS * CELLS * CELLS, 1, span + 1, span + 1))
    for channel in range(len(picks)):
        i, j = divmod(channel % (CELLS * CELLS), CELLS)
        picks[channel, 0, step * i, step * j] = 1.0
    # An odd number of cells' steps: the mean of both middles.
    half = span // 2
    sides = g.constant([0, 0, half, half, 0, 0, half, half], np.int64)
    cells = g.add(
        "Conv", g.add("Pad", pooled, sides, mode="edge"), g.constant(picks), group=DIRECTIONS
    )
    return g.add("Sqrt", g.add("Add", cells, g.constant(1e-6)), out=out)


def listed(g: Graph, heat: str, descriptors: str, width: int, count: int) -> None:
    """The strongest corners as lists; for images of one width only."""
    border = PEAK_PX // 2
    highest = g.add(
        "MaxPool", heat, kernel_shape=[PEAK_PX, PEAK_PX], strides=[1, 1], pads=[border] * 4
    )
    peaks = g.add("Mul", heat, g.add("Cast", g.add("Equal", heat, highest), to=1))
    flat = g.add("Reshape", peaks, g.constant([-1], np.int64))
    g.nodes.append(
        helper.make_node("TopK", [flat, g.constant([count], np.int64)], ["scores", "place"])
    )
    columns = g.constant(width, np.int64)
    v = g.add("Div", "place", columns)
    u = g.add("Sub", "place", g.add("Mul", v, columns))
    last = g.constant([1], np.int64)
    pair = g.add("Concat", g.add("Unsqueeze", u, last), g.add("Unsqueeze", v, last), axis=1)
    g.add("Cast", pair, to=1, out="keypoints")
    stride, coarse = g.constant(STRIDE, np.int64), g.constant(width // STRIDE, np.int64)
    row = g.add("Mul", g.add("Div", v, stride), coarse)
    cell = g.add("Add", row, g.add("Div", u, stride))
    depth = g.constant([DIRECTIONS * CELLS * CELLS, -1], np.int64)
    table = g.add("Transpose", g.add("Reshape", descriptors, depth), perm=[1, 0])
    g.add("Gather", table, cell, out="descriptors", axis=0)


def make(path: Path, points: tuple[int, int, int] | None = None) -> Path:
    """Write the model; `points` (count, width, height) makes it give lists for that size."""
    g = Graph()
    du, dv = gradients(g, "image")
    heat = corners(g, du, dv)
    told = histograms(g, du, dv, "map" if points else "descriptors")
    kind = onnx.TensorProto.FLOAT
    sides: list[int | str] = ["h", "w"]
    outputs = {"heat": [1, 1, None, None], "descriptors": [1, 128, None, None]}
    if points is not None:
        count, width, height = points
        listed(g, heat, told, width, count)
        sides = [height, width]
        outputs = {"keypoints": [count, 2], "descriptors": [count, 128], "scores": [count]}
    graph = helper.make_graph(
        g.nodes,
        "corners",
        [helper.make_tensor_value_info("image", kind, [1, 1, *sides])],
        [helper.make_tensor_value_info(name, kind, shape) for name, shape in outputs.items()],
        g.constants,
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=9)
    onnx.checker.check_model(model)
    onnx.save(model, path)
    return path


def main() -> None:
    """Write the model that the command line names."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("out", type=Path, metavar="OUT.onnx")
    parser.add_argument("--points", type=int, nargs=3, metavar=("COUNT", "WIDTH", "HEIGHT"))
    arguments = parser.parse_args()
    make(arguments.out, tuple(arguments.points) if arguments.points else None)


if __name__ == "__main__":
    main()
