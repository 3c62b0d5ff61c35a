# SPDX-License-Identifier: Apache-2.0
"""Lines that are there more than once: of two maps of one place, or of tracks that never met."""

from typing import TYPE_CHECKING

import numpy as np

from edge.tiles.lines import LOWER
from edge.types import F64

if TYPE_CHECKING:
    from maps.lines.layer import LineLayer

_SIGMAS = 3.0
_LEAST_TILT_RAD, _LEAST_SHARE = 0.005, 0.002  # of agreement; the share is of the longer line
_OVERLAP = 0.3  # of the shorter line


def without_twins(layer: "LineLayer") -> "LineLayer":
    """The lines, each of them once: that which most views agree on stands for all of its twins."""
    n = len(layer.point)
    length = layer.span[:, 1] - layer.span[:, 0]
    shift, tilt = _sigmas(layer)
    rank = np.lexsort((np.arange(n), -layer.n_views))
    leader = np.full(n, -1)
    for i in rank:
        if leader[i] >= 0:
            continue
        leader[i] = i
        away = layer.point - layer.point[i]
        along = away @ layer.direction[i]
        cosine = layer.direction @ layer.direction[i]
        low = np.maximum(layer.span[i, 0], along + layer.span[:, 0])
        high = np.minimum(layer.span[i, 1], along + layer.span[:, 1])
        enough = high - low > _OVERLAP * np.minimum(length, length[i])
        turn = np.sqrt(np.maximum(1.0 - cosine**2, 0.0))
        near_turn = turn < _SIGMAS * np.hypot(tilt, tilt[i]) + _LEAST_TILT_RAD
        # Compared amid what both show; a line that runs askew is judged by its turn.
        middle = 0.5 * (low + high)
        own = layer.point[i] + middle[:, None] * layer.direction[i]
        other = layer.point + (middle - along)[:, None] * layer.direction
        gap = np.linalg.norm(other - own, axis=1)
        sigma = np.hypot(shift, shift[i])
        near = gap < _SIGMAS * sigma + _LEAST_SHARE * np.maximum(length, length[i])
        leader[(leader < 0) & enough & near_turn & near & (cosine > 0.0)] = i
    return _led(layer, leader)


def _sigmas(layer: "LineLayer") -> tuple[F64, F64]:
    """Greatest sigma of each line's place, and of its direction."""
    lower = np.zeros((len(layer.point), 4, 4))
    lower[:, LOWER[0], LOWER[1]] = layer.lower
    variance = np.einsum("nij,nij->ni", lower, lower)
    return np.sqrt(variance[:, :2].max(axis=1)), np.sqrt(variance[:, 2:].max(axis=1))


def _led(layer: "LineLayer", leader: np.ndarray) -> "LineLayer":
    """The layer of leaders, which take over the views and the extent of those that they lead."""
    kept, number = np.unique(leader, return_inverse=True)
    along = np.einsum("ni,ni->n", layer.point - layer.point[leader], layer.direction[leader])
    span = np.column_stack((np.full(len(kept), np.inf), np.full(len(kept), -np.inf)))
    np.minimum.at(span[:, 0], number, along + layer.span[:, 0])
    np.maximum.at(span[:, 1], number, along + layer.span[:, 1])
    seen = np.unique(np.column_stack((layer.view, number[layer.line])), axis=0).astype(np.int32)
    counts = np.bincount(seen[:, 1], minlength=len(kept)).astype(np.int64)
    return layer._replace(
        point=layer.point[kept],
        direction=layer.direction[kept],
        span=span,
        lower=layer.lower[kept],
        n_views=np.maximum(counts, layer.n_views[kept]),
        view=seen[:, 0].copy(),
        line=seen[:, 1].copy(),
    )
