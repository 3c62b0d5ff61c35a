# SPDX-License-Identifier: Apache-2.0
"""Poses and inverse depths from a few corners and the edges between them.

A room without texture shows too few corners for two views to be told apart by them alone. A
straight edge adds two points, its ends in the reference: in every later frame each must lie on
the edge there, wherever along it. How an edge moves at first says nothing of the camera's motion,
since some depths explain any; it is the third view and every further one that does.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from edge.geometry import se3
from edge.odometry import kernels_line_start as kl
from edge.odometry import kernels_start as ks
from edge.odometry.bundle import (
    NO_HUBER,
    System,
    depth_sigma,
    goes_the_same_way,
    rescaled,
    reversed_relief,
)
from edge.odometry.kernels_line_descent import descend
from edge.odometry.structure import Structure
from edge.types import F64, U8, Bools, Mat4


def _to_all_sides() -> F64:
    """Unit vectors (26, 3) to the middles of a cube's faces and edges, and to its corners."""
    steps = np.array([s for s in np.ndindex(3, 3, 3) if s != (1, 1, 1)]) - 1.0
    return np.asarray(steps / np.linalg.norm(steps, axis=1, keepdims=True))


# Residuals [px] that count fully, and beyond which a corner or edge is left out. At true poses,
# edges of simulated rooms are 0.05 to 0.2 off, corners 0.1 to 5: many are places where one edge
# passes behind another, and those slide.
_HUBER_PX = 0.3
_CORNER_WORTH = 0.04  # of a corner's square, of an end's
_CORNER_OUTLIER_PX, _OUTLIER_PX = 1.2, 0.6
# Edges are seen no better than this, whatever the residuals of a few frames say.
_SIGMA_PX = 0.06
# Inverse depths are one at the middle and, before anything is seen, so uncertain. An edge that
# moves along itself tells nothing of its depth, and would end up behind the camera.
_PRIOR_SIGMA, _PRIOR_PX = 0.7, 0.1
_GUESSED_BASELINE = 0.05  # over depth
# Steps of the rotations that guesses begin from, and their kernel: parallax is no outlier there.
_TURNS, _TURN_HUBER_PX = 8, 5.0
# Steps of each guess, after which the best ones go on.
_GUESS_ROUNDS, _ROUNDS, _TAKEN_FURTHER = 8, 40, 10
# With the six directions of the axes alone, half of the wrong starts were minima that fit three
# times worse than one that no guess led to.
_DIRECTIONS = _to_all_sides()
# Residuals count no more than this where minima are compared.
_LIMIT_PX = 1.0
# Share of corners and edges that must lie ahead of the camera.
_MIN_AHEAD = 0.5


class Seen(NamedTuple):
    """Corners and ends of edges of a reference, and where later frames show them.

    All in focal lengths from the axis.
    """

    corner: F64  # (n, 2)
    corner_at: F64  # (m, n, 2)
    corner_seen: U8  # (m, n)
    end: F64  # (k, 2)
    line: F64  # (m, k, 3) a x + b y + c of the edge, a a + b b = 1
    line_seen: U8  # (m, k)


class _Minimum(NamedTuple):
    """Where a descent has come to."""

    poses: list[Mat4]
    idepth: F64
    squared: F64  # (m, n + k) residuals


class Found(NamedTuple):
    """A reconstruction, how well it fits and how well the best other one does."""

    structure: Structure
    fit_px: float  # root mean square over all that was seen, outliers at the limit
    rival_px: float  # the same of the best that goes another way; infinite where there is none


def reconstruct(seen: Seen, focal_px: float) -> Found | None:
    """The reconstruction that explains most; None where there is none.

    All directions of motion are tried from a flat scene: there is no closed form for so little.
    The depths come corners first, then ends. Some corners are where one edge passes behind
    another, and some edges are followed wrongly, so minima are judged without their outliers.
    """
    found = _minima(seen, focal_px)
    if not found:
        return None
    best = found[0]
    good = _good(best, seen, focal_px)
    kept = _without(seen, good)
    again = _adjust(kept, best.poses, np.where(good, best.idepth, 1.0), focal_px)
    if again is None:
        return None
    good &= again.idepth > 0.0
    others = [*found[1:], _reversed(seen, again, good, focal_px)]
    rivals = [
        _fit_px(other, seen, focal_px)
        for other in others
        if other is not None and not goes_the_same_way(other.poses[-1], again.poses[-1])
    ]
    kept = _without(seen, good)
    rms = _rms_px(again, kept, focal_px)
    system = _system(kept, again.poses, again.idepth)
    sigma = depth_sigma(system, again.poses, max(rms, _SIGMA_PX) / focal_px)
    structure = _scaled(again, good, sigma, rms)
    return Found(structure, _fit_px(best, seen, focal_px), min(rivals, default=np.inf))


def _minima(seen: Seen, focal_px: float) -> list[_Minimum]:
    """Where the most promising guesses lead, best first."""
    flat = np.ones(len(seen.corner) + len(seen.end))

    def fit_px(state: _Minimum) -> float:
        return _fit_px(state, seen, focal_px)

    begun = [
        _adjust(seen, poses, flat, focal_px, _GUESS_ROUNDS) for poses in _guesses(seen, focal_px)
    ]
    order = sorted(filter(None, begun), key=fit_px)[:_TAKEN_FURTHER]
    ended = [_adjust(seen, state.poses, state.idepth, focal_px) for state in order]
    ahead = [s for s in ended if s is not None and np.mean(s.idepth > 0.0) > _MIN_AHEAD]
    return sorted(ahead, key=fit_px)


def _guesses(seen: Seen, focal_px: float) -> list[list[Mat4]]:
    """Motions to begin with: the camera gone to each side, and turned as everything seems to."""
    turned = _turned_only(seen, focal_px)
    m = len(turned)
    guesses = []
    for direction in _DIRECTIONS:
        poses = []
        for k, T in enumerate(turned):
            t = _GUESSED_BASELINE * (k + 1) / m * direction
            # What lies at the middle depth stays in place.
            poses.append(se3.exp(np.array([*t, t[1], -t[0], 0.0])) @ T)
        guesses.append(poses)
    return guesses


def _turned_only(seen: Seen, focal_px: float) -> list[Mat4]:
    """Rotations of each frame that explain most, as if all were far away."""
    poses = [np.eye(4) for _ in range(len(seen.corner_at))]
    far = np.zeros(len(seen.corner) + len(seen.end))
    for _ in range(_TURNS):
        system = _system(seen, poses, far, _TURN_HUBER_PX / focal_px)
        for k in range(len(poses)):
            at = slice(6 * k + 3, 6 * k + 6)
            H = system.H[at, at]
            step = -np.linalg.solve(H + (1e-9 + 1e-6 * np.trace(H)) * np.eye(3), system.b[at])
            poses[k] = se3.exp(np.array([0.0, 0.0, 0.0, *step])) @ poses[k]
    return poses


def _reversed(seen: Seen, state: _Minimum, good: Bools, focal_px: float) -> _Minimum | None:
    """The minimum near the same scene as a reversed relief, seen from the other side."""
    mean = float(np.mean(state.idepth[good])) if np.any(good) else 1.0
    poses = [reversed_relief(T, mean) for T in state.poses]
    idepth = np.maximum(2.0 * mean - state.idepth, 0.1 * mean)
    found = _adjust(seen, poses, idepth, focal_px)
    return found if found is not None and np.mean(found.idepth > 0.0) > _MIN_AHEAD else None


def _good(state: _Minimum, seen: Seen, focal_px: float) -> Bools:
    """Corners and ends (n + k,) that fit in every frame that sees them."""
    visible = np.hstack((seen.corner_seen, seen.line_seen)) > 0
    limit = np.full(len(state.idepth), _OUTLIER_PX)
    limit[: len(seen.corner)] = _CORNER_OUTLIER_PX
    fits = np.sqrt(state.squared) * focal_px < limit
    good = np.all(fits | ~visible, axis=0) & np.any(visible, axis=0) & (state.idepth > 0.0)
    # One end of an edge says nothing of it without the other.
    pairs = good[len(seen.corner) :].reshape(-1, 2).all(axis=1)
    good[len(seen.corner) :] = np.repeat(pairs, 2)
    return np.asarray(good)


def _without(seen: Seen, good: Bools) -> Seen:
    n = len(seen.corner)
    return seen._replace(
        corner_seen=(seen.corner_seen * good[None, :n]).astype(np.uint8),
        line_seen=(seen.line_seen * good[None, n:]).astype(np.uint8),
    )


def _fit_px(state: _Minimum, seen: Seen, focal_px: float) -> float:
    """Root mean square of all residuals, those beyond the limit and behind the camera at it."""
    squared = np.minimum(state.squared * focal_px**2, _LIMIT_PX**2)
    squared[:, state.idepth <= 0.0] = _LIMIT_PX**2
    return _root_mean(squared, seen)


def _rms_px(state: _Minimum, seen: Seen, focal_px: float) -> float:
    return _root_mean(state.squared, seen) * focal_px


def _root_mean(squared: F64, seen: Seen) -> float:
    """Of squares (m, n + k), by what they count; infinite where nothing is seen."""
    worth = np.hstack((_CORNER_WORTH * seen.corner_seen, seen.line_seen))
    total = float(worth.sum())
    return float(np.sqrt((worth * squared).sum() / total)) if total > 0.0 else np.inf


def _system(seen: Seen, poses: Sequence[Mat4], idepth: F64, huber: float = NO_HUBER) -> System:
    T, n = np.stack(poses), len(seen.corner)
    R, t = np.ascontiguousarray(T[:, :3, :3]), np.ascontiguousarray(T[:, :3, 3])
    parts = (
        (ks.accumulate, seen.corner, idepth[:n], seen.corner_at, seen.corner_seen),
        (kl.accumulate, seen.end, idepth[n:], seen.line, seen.line_seen),
    )
    systems = []
    for accumulate, rays, depth, at, visible in parts:
        m, count = visible.shape
        H, b, W = np.empty((6 * m, 6 * m)), np.empty(6 * m), np.empty((6 * m, count))
        Hd, bd, squared = np.empty(count), np.empty(count), np.empty((m, count))
        cost = accumulate(rays, depth, at, visible, R, t, huber, H, b, Hd, bd, W, squared)
        systems.append(System(cost, H, b, W, Hd, bd, squared))
    corners, edges = systems
    worth = _CORNER_WORTH
    return System(
        worth * corners.cost + edges.cost,
        worth * corners.H + edges.H,
        worth * corners.b + edges.b,
        np.hstack((worth * corners.W, edges.W)),
        np.concatenate((worth * corners.Hd, edges.Hd)),
        np.concatenate((worth * corners.bd, edges.bd)),
        np.hstack((corners.squared, edges.squared)),
    )


def _adjust(
    seen: Seen, poses: Sequence[Mat4], idepth: F64, focal_px: float, rounds: int = _ROUNDS
) -> _Minimum | None:
    T, idepth = np.stack(poses), np.array(idepth)
    R, t = np.ascontiguousarray(T[:, :3, :3]), np.ascontiguousarray(T[:, :3, 3])
    squared = np.empty((len(T), len(idepth)))
    huber = _HUBER_PX / focal_px
    prior = (_PRIOR_PX / _PRIOR_SIGMA / focal_px) ** 2
    cost = descend(*seen, _CORNER_WORTH, huber, prior, rounds, R, t, idepth, squared)
    if not np.isfinite(cost) or not np.all(np.isfinite(idepth)):
        return None
    ended = [se3.from_rotation_translation(*pose) for pose in zip(R, t, strict=True)]
    return _Minimum(ended, idepth, squared)


def _scaled(state: _Minimum, good: Bools, sigma: F64, rms_px: float) -> Structure:
    """The structure with a median inverse depth of one."""
    scale = float(np.median(state.idepth[good])) if np.any(good) else 1.0
    return Structure(
        T_frame_reference=rescaled(state.poses, scale),
        inverse_depth=state.idepth / scale,
        relative_sigma=sigma / np.maximum(state.idepth, 1e-9),
        inlier=good.astype(np.uint8),
        residual_px=rms_px,
    )
