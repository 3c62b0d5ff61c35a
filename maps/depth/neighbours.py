# SPDX-License-Identifier: Apache-2.0
"""Which views tell the depths of a view: those that see the same from well apart."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edge.types import F64, I32, Mat4
from maps.fusion import Points

I64 = NDArray[np.int64]

_MIN_SHARED = 12  # points
_GOOD_ANGLE_DEG = 6.0  # between the rays to a point: less tells depth worse
_WIDE_ANGLE_DEG = 14.0  # more makes the same thing look different
_KNOWN = 0.7  # of what a point needs, after one view at a good angle
_MAX_TURN_DEG = 40.0  # between the cameras' axes
_NEARER, _FARTHER = 0.75, 1.6  # than nearly all points that a view sees
_SHARE = 2.0  # percent of points that may lie out of the range


class Neighbourhood(NamedTuple):
    """How to find the depths of a view."""

    views: list[int]  # the best first
    rho_range: tuple[float, float]  # inverse depths that occur there


def choose_neighbours(points: Points, poses: list[Mat4], most: int) -> list[Neighbourhood | None]:
    """Neighbours of each view, by the points that they share; None where there are none."""
    seen = _points_of_views(points, len(poses))
    T = np.array(poses)
    found: list[Neighbourhood | None] = []
    for view, rows in enumerate(seen):
        chosen = _cover(*_shared_angles(points, T, view, rows), len(rows), most)
        depth = (points.xyz[rows] - T[view, :3, 3]) @ T[view, :3, 2]
        depth = depth[depth > 0.0]
        if not chosen or len(depth) < _MIN_SHARED:
            found.append(None)
            continue
        near, far = np.percentile(depth, (_SHARE, 100.0 - _SHARE))
        found.append(Neighbourhood(chosen, (1.0 / (_FARTHER * far), 1.0 / (_NEARER * near))))
    return found


def _points_of_views(points: Points, n_views: int) -> list[I64]:
    owner = np.repeat(np.arange(len(points.xyz)), np.diff(points.offsets))
    order = np.argsort(points.view, kind="stable")
    borders = np.searchsorted(points.view[order], np.arange(1, n_views))
    return np.split(owner[order], borders)


def _shared_angles(points: Points, T: F64, view: int, rows: I64) -> tuple[I32, I64, F64]:
    """Every other view of the points `rows` of a view: the view, which row, the angle [deg]."""
    starts, ends = points.offsets[rows], points.offsets[rows + 1]
    counts = ends - starts
    index = np.repeat(starts - np.cumsum(counts) + counts, counts) + np.arange(counts.sum())
    others, row = points.view[index], np.repeat(np.arange(len(rows)), counts)
    own = _unit(T[view, :3, 3] - points.xyz[rows[row]])
    ray = _unit(T[others, :3, 3] - points.xyz[rows[row]])
    angle = np.rad2deg(np.arccos(np.clip(np.einsum("ni,ni->n", own, ray), -1.0, 1.0)))
    shared = np.bincount(others, minlength=len(T))
    turn = np.rad2deg(np.arccos(np.clip(T[:, :3, 2] @ T[view, :3, 2], -1.0, 1.0)))
    usable = (shared >= _MIN_SHARED) & (turn <= _MAX_TURN_DEG)
    usable[view] = False
    kept = usable[others]
    return others[kept], row[kept], angle[kept]


def _cover(views: I32, row: I64, angle: F64, n_points: int, most: int) -> list[int]:
    """Views that together measure as many points as can be, each view for those still badly known.

    The first is the best alone; later ones count less where earlier ones measure well.
    """
    weight = np.minimum(angle / _GOOD_ANGLE_DEG, 1.0)
    weight *= np.minimum(_WIDE_ANGLE_DEG / np.maximum(angle, 1e-9), 1.0) ** 3
    need = np.ones(n_points)
    chosen: list[int] = []
    while len(chosen) < most and len(views):
        gain = np.bincount(views, weight * need[row])
        gain[chosen] = 0.0
        best = int(np.argmax(gain))
        if gain[best] <= 0.0:
            break
        chosen.append(best)
        own = views == best
        need[row[own]] *= 1.0 - _KNOWN * weight[own]
    return chosen


def _unit(vectors: F64) -> F64:
    unit: F64 = vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-12)
    return unit
