# SPDX-License-Identifier: Apache-2.0
"""Key points and their descriptors, read from the maps of a dense model."""

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from edge.learned.contract import CELL_PX
from edge.types import F32

_PEAK_PX = 5  # side of the window in which a key point is the only one
_LEAST_CELL_PROBABILITY = 0.03  # of a pixel of a cell; evenly spread they had 0.015
_TINY = 1e-12
_Rows = NDArray[np.intp]


class Found(NamedTuple):
    """What a model sees in an image."""

    pixels: F32  # (n, 2) u, v of the image that it was given
    scores: F32  # (n,)
    descriptors: F32  # (n, d) of unit length


def read_maps(places: F32, descriptors: F32, worth: F32 | None, count: int) -> Found:
    """Return the best `count` key points of an image.

    places       (65, h / 8, w / 8) logits of the pixels of each cell and of none, or (1, h, w) heat
    descriptors  (d, h', w')
    worth        (1, h', w') how reliable descriptors are, if known
    """
    heat = places[0] if len(places) == 1 else _of_cells(places)
    height, width = heat.shape
    peaks = heat >= cv2.dilate(heat, np.ones((_PEAK_PX, _PEAK_PX), np.uint8))
    peaks &= heat > (0.0 if len(places) == 1 else _LEAST_CELL_PROBABILITY)
    v, u = np.nonzero(peaks[1:-1, 1:-1])
    u, v = u + 1, v + 1
    pixels = np.column_stack((u, v)).astype(np.float32)
    score = heat[v, u]
    if worth is not None:
        score = score * np.maximum(_sampled(worth, pixels, width, height)[:, 0], 0.0)
    best = np.argsort(-score, kind="stable")[:count]
    best = best[score[best] > 0.0]
    u, v = u[best], v[best]
    pixels = pixels[best] + np.column_stack((_vertex(heat, v, u, 0, 1), _vertex(heat, v, u, 1, 0)))
    told = unit(_sampled(unit(descriptors, axis=0), pixels, width, height))
    return Found(pixels.astype(np.float32), score[best], told)


def unit(vectors: F32, axis: int = 1) -> F32:
    """Vectors of unit length."""
    norm = np.linalg.norm(vectors, axis=axis, keepdims=True)
    return np.asarray(vectors / np.maximum(norm, _TINY), np.float32)


def _of_cells(logits: F32) -> F32:
    """Probability (h, w) of each pixel, where its cell's logits (65, h / 8, w / 8) are given."""
    raised = np.exp(logits - logits.max(axis=0))
    cells = raised[:-1] / raised.sum(axis=0)
    _, h, w = cells.shape
    grid = cells.reshape(CELL_PX, CELL_PX, h, w).transpose(2, 0, 3, 1)
    return np.ascontiguousarray(grid.reshape(h * CELL_PX, w * CELL_PX), np.float32)


def _vertex(heat: F32, v: _Rows, u: _Rows, dv: int, du: int) -> F32:
    """How far (n,) [px] beyond each peak the parabola through it and its neighbours is highest."""
    low, here, high = (np.log(np.maximum(heat[v + k * dv, u + k * du], _TINY)) for k in (-1, 0, 1))
    bend = low - 2.0 * here + high
    offset = np.where(bend < -_TINY, 0.5 * (low - high) / np.minimum(bend, -_TINY), 0.0)
    return np.asarray(np.clip(offset, -0.5, 0.5), np.float32)


def _sampled(layers: F32, pixels: F32, width: int, height: int) -> F32:
    """Values (n, c) between the places of layers (c, h', w') that cover the image."""
    h, w = layers.shape[1:]
    x = np.clip((pixels[:, 0] + 0.5) * (w / width) - 0.5, 0.0, w - 1.0)
    y = np.clip((pixels[:, 1] + 0.5) * (h / height) - 0.5, 0.0, h - 1.0)
    x0, y0 = np.minimum(x.astype(int), max(w - 2, 0)), np.minimum(y.astype(int), max(h - 2, 0))
    x1, y1 = np.minimum(x0 + 1, w - 1), np.minimum(y0 + 1, h - 1)
    a, b = (x - x0)[:, None], (y - y0)[:, None]
    upper = (1.0 - a) * layers[:, y0, x0].T + a * layers[:, y0, x1].T
    lower = (1.0 - a) * layers[:, y1, x0].T + a * layers[:, y1, x1].T
    return np.asarray((1.0 - b) * upper + b * lower, np.float32)
