# SPDX-License-Identifier: Apache-2.0
"""Makes a feature model: `python -m tools.corner_model OUT.onnx [--points COUNT]`.

Harris corners and histograms of gradients around them, written as means and differences: no
training, no weights from anybody. What it gives has the form of a trained model's, so that all
that stands behind learned features can be tried with features whose working is known. With
`--points` it picks its corners itself and gives lists, as models do that were exported whole.
"""

import argparse
from pathlib import Path

import numpy as np

try:
    import onnx
    from onnx import helper
except ImportError:
    raise SystemExit("tools.corner_model needs onnx: `tools/install dev` brings it") from None

from tools.key_colour_model import Graph

OPSET = 18
DIRECTIONS = 8
CELLS = 4  # of a descriptor, each way
STRIDE = 4  # pixels between places of the descriptor map
CELL_PX = 8
PEAK_PX = 5
_TO_THE_END = np.iinfo(np.int64).max
EDGE = 0.05  # Harris: how much a second direction counts


def averaged(g: Graph, image: str, times: int) -> str:
    """Each channel smoothed by means of 3 x 3; at the border those of fewer."""
    for _ in range(times):
        image = g.add("AveragePool", image, kernel_shape=[3, 3], strides=[1, 1], pads=[1] * 4)
    return image


def gradients(g: Graph, image: str) -> tuple[str, str]:
    """Slopes (1, 1, h, w) along u and v."""
    smooth = averaged(g, image, 2)
    slopes = []
    for axis in (3, 2):
        pads = np.zeros(8, np.int64)
        pads[axis] = pads[axis + 4] = 1
        padded = g.add("Pad", smooth, g.constant(pads, np.int64), mode="edge")
        before, after = (
            g.add("Slice", padded, *(g.constant([v], np.int64) for v in (begin, end, axis)))
            for begin, end in ((0, -2), (2, _TO_THE_END))
        )
        slopes.append(g.add("Sub", after, before))
    return slopes[0], slopes[1]


def corners(g: Graph, du: str, dv: str) -> str:
    """Heat (1, 1, h, w): high where the image changes both ways."""
    uu, vv, uv = (averaged(g, g.add("Mul", a, b), 3) for a, b in ((du, du), (dv, dv), (du, dv)))
    trace = g.add("Add", uu, vv)
    determinant = g.add("Sub", g.add("Mul", uu, vv), g.add("Mul", uv, uv))
    edge = g.add("Mul", g.add("Mul", trace, trace), g.constant(EDGE))
    return g.add("Relu", g.add("Sub", determinant, edge), out="heat")


def histograms(g: Graph, du: str, dv: str, out: str) -> str:
    """Descriptors (1, 128, h / 4, w / 4): slopes by direction in 4 x 4 cells around each place."""
    angles = 2.0 * np.pi * np.arange(DIRECTIONS).reshape(1, DIRECTIONS, 1, 1) / DIRECTIONS
    along = (g.add("Mul", d, g.constant(f(angles))) for d, f in ((du, np.cos), (dv, np.sin)))
    strengths = g.add("Relu", g.add("Add", *along))
    tile = [STRIDE, STRIDE]
    binned = g.add("AveragePool", strengths, kernel_shape=tile, strides=tile)
    pooled = g.add("Sqrt", averaged(g, binned, 2))
    # Cells around a place: the pooled map, shifted by each cell's steps.
    step = CELL_PX // STRIDE
    last = step * (CELLS - 1)
    around = g.constant([0, 0, last // 2, last // 2, 0, 0, last // 2, last // 2], np.int64)
    padded = g.add("Pad", pooled, around, mode="edge")
    axes = g.constant([2, 3], np.int64)
    shifted = []
    for i, j in np.ndindex(CELLS, CELLS):
        begin = np.array((step * i, step * j))
        end = np.where(begin < last, begin - last, _TO_THE_END)
        bounds = (g.constant(bound, np.int64) for bound in (begin, end))
        shifted.append(g.add("Slice", padded, *bounds, axes))
    return g.add("Concat", *shifted, out=out, axis=1)


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
