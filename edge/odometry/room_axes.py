# SPDX-License-Identifier: Apache-2.0
"""The three axes of a room, from its edges: they tell how the camera turned, and nothing else does.

Most edges of rooms run along three directions at right angles. Where their images meet tells the
camera's rotation whatever its place; without it, a small turn and a small step look nearly alike.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edge.geometry import so3
from edge.types import F64, Bools

I64 = NDArray[np.int64]

# Of an edge off its axis, at its end [px]: what counts a quarter where axes are looked for and
# where they are known; beyond the last one an edge belongs to none.
_SEARCH_PX, _COARSE_PX, _FINE_PX, _OFF_PX = 0.4, 1.5, 0.3, 0.6
# Of all edges, by length, that must run along the axes.
_MIN_SHARE = 0.6
# Edges of which pairs are tried, and pairs that are tried with each third edge: the time that
# takes grows with the square.
_LONGEST, _TRIED = 24, 40
# Sines below which two edges tell no direction, and an edge no second one.
_MIN_SINE, _MIN_THIRD_SINE = 0.03, 0.3
# An edge towards whose direction the camera looks tells less of it.
_MIN_LEVER = 0.2
_ROUNDS, _COARSE_STEPS, _STEPS = 3, 5, 3
_TINY = 1e-2  # [px^2 / rad^2] beside what edges say: hundreds squared


class Planes(NamedTuple):
    """Planes through a camera's centre and the edges that it sees; NaN where it does not."""

    normal: F64  # (k, 3) of unit length
    middle: F64  # (k, 3) unit vectors to the edges' middles
    worth_px: F64  # (k,) an end's shift by a turn of the edge about its middle [px / rad]


class Turned(NamedTuple):
    """Edges along the axes, and how the camera turned; none where the axes are not known."""

    along: F64  # (k, 3) directions of edges in the reference
    normal: F64  # (m, k, 3) their planes in the other frames, `along` them [focal lengths], or 0
    R: F64  # (m, 3, 3) R_frame_reference


def unknown(frames: int) -> Turned:
    """Nothing, of so many frames."""
    return Turned(np.empty((0, 3)), np.empty((frames, 0, 3)), np.empty((0, 3, 3)))


def planes(ends: F64, focal_px: float) -> Planes:
    """Of edges whose ends (k, 4) are in focal lengths from the axis."""
    one = np.column_stack((ends[:, :2], np.ones(len(ends))))
    other = np.column_stack((ends[:, 2:], np.ones(len(ends))))
    half = 0.5 * np.linalg.norm(ends[:, 2:] - ends[:, :2], axis=1)
    return Planes(_unit(np.cross(one, other)), _unit(one + other), focal_px * half)


def turned(reference: Planes, others: Sequence[Planes], place: int, focal_px: float) -> Turned:
    """How the camera turned in `others`, in their order, the reference between them at `place`.

    No edges and no rotations where the reference shows no axes.
    """
    axes = _axes(reference)
    if axes is None:
        return unknown(len(others))
    views = [*others[:place], reference, *others[place:]]
    rotations = [np.eye(3) for _ in views]
    off = _off_px(reference, axes.T)
    axis = np.argmin(np.abs(off), axis=1)
    used = _least(off) < _COARSE_PX
    outward = [*range(place + 1, len(views)), *range(place - 1, -1, -1)]
    for k in outward:
        before = rotations[k - 1 if k > place else k + 1]
        rotations[k] = _turn(views[k], axes[:, axis].T, used, before, _COARSE_PX, _COARSE_STEPS)
    for _ in range(_ROUNDS):
        for k in outward:
            along = axes[:, axis].T
            rotations[k] = _turn(views[k], along, used, rotations[k], _FINE_PX, _STEPS)
        axes = _moved(axes, axis, used, views, rotations)
    edges = np.flatnonzero(used & (_least(_off_px(reference, axes.T)) < _OFF_PX))
    along = axes[:, axis[edges]].T
    R = np.stack([rotations[k] for k in range(len(views)) if k != place])
    normal = [
        _levers(view, along @ Rk.T, edges)[:, None] / focal_px * view.normal[edges]
        for view, Rk in zip(others, R, strict=True)
    ]
    return Turned(np.ascontiguousarray(along), np.nan_to_num(np.stack(normal)), R)


def _axes(seen: Planes) -> F64 | None:
    """Axes (3, 3), one a column, along which most edges run; None where too few do."""
    longest = seen.normal[np.argsort(-seen.worth_px, kind="stable")[:_LONGEST]]
    one, other = np.triu_indices(len(longest), 1)
    first = np.cross(longest[one], longest[other])
    sine = np.linalg.norm(first, axis=1)
    first = first[sine > _MIN_SINE] / sine[sine > _MIN_SINE, None]
    by_first = _off_px(seen, first).T ** 2
    order = np.argsort(-_support(by_first, seen), kind="stable")[:_TRIED]
    best, axes = _MIN_SHARE * float(seen.worth_px.sum()), None
    for k in order:
        # The second axis stands on the first and lies in the plane of an edge, whichever.
        second = np.cross(longest, first[k])
        sine = np.linalg.norm(second, axis=1)
        second = second[sine > _MIN_THIRD_SINE] / sine[sine > _MIN_THIRD_SINE, None]
        third = np.cross(first[k], second)
        squared = np.minimum(_off_px(seen, second).T ** 2, _off_px(seen, third).T ** 2)
        support = _support(np.minimum(squared, by_first[k]), seen)
        if len(support) and support.max() > best:
            n = int(np.argmax(support))
            best, axes = float(support[n]), np.column_stack((first[k], second[n], third[n]))
    return axes


def _support(squared: F64, seen: Planes) -> F64:
    """Length of the edges that agree (c,), by squares (c, k) of how far they are off."""
    return np.asarray((seen.worth_px / (1.0 + squared / _SEARCH_PX**2)).sum(axis=1))


def _off_px(seen: Planes, directions: F64) -> F64:
    """How far an edge's end (k, c) is off each direction (c, 3)."""
    lever = np.linalg.norm(np.cross(seen.middle[:, None], directions[None]), axis=2)
    return np.asarray(
        seen.worth_px[:, None] * (seen.normal @ directions.T) / np.maximum(lever, _MIN_LEVER)
    )


def _least(off_px: F64) -> F64:
    return np.asarray(np.abs(off_px).min(axis=1))


def _levers(view: Planes, along: F64, which: I64 | Bools) -> F64:
    """What an edge's end shifts (k,) [px] by a turn of its direction `along` (k, 3)."""
    lever = np.linalg.norm(np.cross(view.middle[which], along), axis=1)
    return np.asarray(view.worth_px[which] / np.maximum(lever, _MIN_LEVER))


def _turn(view: Planes, along: F64, used: Bools, R: F64, limit_px: float, steps: int) -> F64:
    """The rotation near R that puts directions (k, 3) into their edges' planes."""
    which = used & np.isfinite(view.normal[:, 0])
    normal, along = view.normal[which], along[which]
    for _ in range(steps):
        v = along @ R.T
        H, b = _normal_equations(normal, v, np.cross(v, normal), _levers(view, v, which), limit_px)
        R = so3.exp(-np.linalg.solve(H, b)) @ R
    return R


def _moved(
    axes: F64, axis: I64, used: Bools, views: Sequence[Planes], rotations: Sequence[F64]
) -> F64:
    """The axes after one step that all views take together."""
    H, b = np.zeros((3, 3)), np.zeros(3)
    for view, R in zip(views, rotations, strict=True):
        which = used & np.isfinite(view.normal[:, 0])
        along = axes[:, axis[which]].T
        normal, v = view.normal[which], along @ R.T
        turn = np.cross(along, normal @ R)
        dH, db = _normal_equations(normal, v, turn, _levers(view, v, which), _FINE_PX)
        H, b = H + dH, b + db
    return np.asarray(so3.exp(-np.linalg.solve(H, b)) @ axes)


def _normal_equations(
    normal: F64, v: F64, turn: F64, lever_px: F64, limit_px: float
) -> tuple[F64, F64]:
    """Of n . v = 0 [px] by a turn, rows of whose derivative are `turn` (k, 3); Geman-McClure."""
    r = lever_px * np.sum(normal * v, axis=1)
    weight = 1.0 / (1.0 + (r / limit_px) ** 2) ** 2
    J = lever_px[:, None] * turn
    return (J * weight[:, None]).T @ J + _TINY * np.eye(3), J.T @ (weight * r)


def _unit(vectors: F64) -> F64:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))
