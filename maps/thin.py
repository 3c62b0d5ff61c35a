# SPDX-License-Identifier: Apache-2.0
"""Drops keyframes that add no coverage: whose points others see as well."""

import heapq
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from edge.tiles.manifest import Manifest
from edge.tiles.reader import open_map
from maps.content import Content, load, select, write
from maps.learned import load_layer
from maps.writer import check_not_source

# Another view counts for a point only from a like direction and distance: ORB knows it no more
# beyond half an octave's share of its pyramid, and 20 degrees aside.
_MAX_ANGLE_RAD = np.deg2rad(20.0)
_MAX_DISTANCE_RATIO = 1.5

I64 = NDArray[np.int64]


def thin(folder: Path, out: Path, share: float, others: int) -> Manifest:
    """Write the map without keyframes of which `share` of the points `others` see as well."""
    check_not_source(out, folder)
    opened = open_map(folder)
    content, learned = load(opened), load_layer(opened)
    kept = needed(content, share, others)
    if learned is not None:
        learned = learned.kept(kept)
    return write(select(content, kept), opened.manifest, out, learned)


def needed(content: Content, share: float, others: int) -> list[int]:
    """Keyframes that stay: none of them could go any more.

    The most dispensable goes first; of equals the later one.
    """
    points = content.points
    n = len(content.views)
    owner = np.repeat(np.arange(len(points.xyz)), np.diff(points.offsets))
    pairs = _alike(content, owner)
    # How many others see each observed point from a like place, by row of the observations.
    seen_by = np.bincount(pairs[0], minlength=len(owner))
    rows = [np.flatnonzero(points.view == k) for k in range(n)]
    starts = np.searchsorted(pairs[0], np.arange(len(owner) + 1))
    queue = [(-_dispensable(seen_by[rows[k]], others), -k) for k in range(n)]
    heapq.heapify(queue)
    left = set(range(n))
    while queue and len(left) > 2:
        negative, minus_k = heapq.heappop(queue)
        k = -minus_k
        now = _dispensable(seen_by[rows[k]], others)
        if now < share:
            continue
        if now < -negative:  # others have gone meanwhile: it comes up again in its turn
            heapq.heappush(queue, (-now, minus_k))
            continue
        left.remove(k)
        for row in rows[k]:
            seen_by[pairs[1][starts[row] : starts[row + 1]]] -= 1
    return sorted(left)


def _dispensable(counts: I64, others: int) -> float:
    """Share of a keyframe's points that enough others see; all, where it has none."""
    return float(np.mean(counts >= others)) if len(counts) else 1.0


def _alike(content: Content, owner: I64) -> tuple[I64, I64]:
    """Pairs of observations of one point from like directions and distances, sorted by the first.

    Both are rows of the observations; each pair is there both ways.
    """
    points = content.points
    centres = np.array([view.T_map_cam[:3, 3] for view in content.views])
    away = centres[points.view] - points.xyz[owner]
    distance = np.linalg.norm(away, axis=1)
    direction = away / np.maximum(distance, 1e-12)[:, None]
    first, second = _pairs(points.offsets)
    cosine = np.einsum("ni,ni->n", direction[first], direction[second])
    ratio = distance[first] / np.maximum(distance[second], 1e-12)
    alike = (cosine > np.cos(_MAX_ANGLE_RAD)) & (first != second)
    alike &= (ratio < _MAX_DISTANCE_RATIO) & (ratio > 1.0 / _MAX_DISTANCE_RATIO)
    return first[alike], second[alike]


def _pairs(offsets: I64) -> tuple[I64, I64]:
    """All ordered pairs of rows of each point, sorted by the first row."""
    counts = np.diff(offsets)
    per_row = np.repeat(counts, counts)  # partners of each row, itself among them
    first = np.repeat(np.arange(len(per_row)), per_row)
    begin = np.repeat(np.repeat(offsets[:-1], counts), per_row)
    turn = np.arange(len(first)) - np.repeat(np.cumsum(per_row) - per_row, per_row)
    return first, begin + turn
