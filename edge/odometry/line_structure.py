# SPDX-License-Identifier: Apache-2.0
"""Poses and inverse depths from edges alone.

A room without texture shows too few corners for two views to be told apart by them. A straight
edge gives two points, its ends in the reference: in every other frame each must lie on the edge
there, wherever along it. How an edge moves at first says nothing of the camera's motion, since
some depths explain any; it is the third view and every further one that does. Two things tell
more: where edges meet they nearly always do so in space, too, and most run along the room's axes.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from edge.geometry import se3
from edge.odometry import kernels_line_start as kl
from edge.odometry.bundle import System, depth_sigma, goes_the_same_way, rescaled, reversed_relief
from edge.odometry.kernels_line_descent import add_directions, descend
from edge.odometry.room_axes import Turned
from edge.odometry.structure import Structure
from edge.types import F64, U8, Bools, Mat4


def _to_all_sides() -> F64:
    """Unit vectors (26, 3) to the middles of a cube's faces and edges, and to its corners."""
    steps = np.array([s for s in np.ndindex(3, 3, 3) if s != (1, 1, 1)]) - 1.0
    return np.asarray(steps / np.linalg.norm(steps, axis=1, keepdims=True))


# Residuals [px] that count a quarter, ever smaller: at true poses nine edges of ten in simulated
# rooms are less than 0.2 off, the others 0.5 to 4, and those must not bend what the nine say.
_LIMITS_PX = (1.0, 0.4, 0.2)
_GUESS_LIMIT_PX = 2.0
_OUTLIER_PX = 0.6
# Edges are seen no better than this, whatever the residuals of a few frames say.
_SIGMA_PX = 0.06
# Inverse depths are one at the middle and, before anything is seen, so uncertain. An edge that
# moves along itself tells nothing of its depth, and would end up behind the camera.
_PRIOR_SIGMA, _PRIOR_PX = 0.7, 0.1
_GUESSED_BASELINE = 0.05  # over depth
# Steps of the rotations that guesses begin from, and their limit: parallax is no outlier there.
_TURNS, _TURN_LIMIT_PX = 8, 10.0
# Steps of each guess, after which the best ones go on.
_GUESS_ROUNDS, _ROUNDS, _TAKEN_FURTHER = 8, 15, 10
# With the six directions of the axes alone, half of the wrong starts were minima that fit three
# times worse than one that no guess led to.
_DIRECTIONS = _to_all_sides()
# Residuals count no more than this where minima are compared.
_MOST_PX = 0.4
# Share of points that must lie ahead of the camera.
_MIN_AHEAD = 0.5
_NO_LIMIT = 1e9
_PARTS = 8  # that are left out in turn


class Seen(NamedTuple):
    """Points on edges of a reference, and where other frames show those edges.

    All in focal lengths from the axis.
    """

    edges: int  # whose ends are the first points, two of each
    place: int  # frames before the reference
    rays: F64  # (n, 2)
    line: F64  # (m, n, 2, 3) a x + b y + c of the edges that meet there, a a + b b = 1, or zeros
    visible: U8  # (m, n)
    turned: Turned  # how the room's axes say that the camera turned


class Minimum(NamedTuple):
    """Where a descent has come to."""

    poses: list[Mat4]
    idepth: F64
    squared: F64  # (m, n) residuals


class Found(NamedTuple):
    """A reconstruction, how well it fits and how well the best other one does."""

    structure: Structure
    fit_px: float  # root mean square over all that was seen, outliers at the limit
    rival_px: float  # the same of the best that goes another way; infinite where there is none
    information: F64  # (6 m, 6 m) of twists on the left of T_frame_reference
    minimum: Minimum  # it came from


def span(poses: Sequence[Mat4], place: int) -> Mat4:
    """T_last_first of frames' T_frame_reference, the reference being at `place` among them."""
    whole = [*poses[:place], np.eye(4), *poses[place:]]
    return np.asarray(whole[-1] @ se3.inverse(whole[0]))


def reconstruct(seen: Seen, focal_px: float) -> Found | None:
    """The reconstruction that explains most; None where there is none.

    All directions of motion are tried from a flat scene: there is no closed form for so little.
    Some edges are followed wrongly, and some only seem to meet: minima are judged by what fits.
    """
    found = _minima(seen, focal_px)
    if not found:
        return None
    best = found[0]
    way = span(best.poses, seen.place)
    rivals = [
        _fit_px(other, seen, focal_px)
        for other in (*found[1:], _reversed(seen, best, focal_px))
        if other is not None and not goes_the_same_way(span(other.poses, seen.place), way)
    ]
    good = _good(best, seen, focal_px)
    kept = seen._replace(visible=(seen.visible * good[None]).astype(np.uint8))
    system = _system(kept, best.poses, best.idepth)
    total = max(int(kept.visible.sum()), 1)
    rms = float(np.sqrt((kept.visible * system.squared).sum() / total)) * focal_px
    noise = max(rms, _SIGMA_PX) / focal_px
    scale = float(np.median(best.idepth[good])) if np.any(good) else 1.0
    return Found(
        Structure(
            T_frame_reference=rescaled(best.poses, scale),
            inverse_depth=best.idepth / scale,
            relative_sigma=depth_sigma(system, best.poses, noise) / np.maximum(best.idepth, 1e-9),
            inlier=good.astype(np.uint8),
            residual_px=rms,
        ),
        _fit_px(best, seen, focal_px),
        min(rivals, default=np.inf),
        _information(system, scale) / noise**2,
        best,
    )


def way_of(poses: Sequence[Mat4], place: int) -> F64:
    """Unit vector (3,) from the first towards the last camera, in the last camera."""
    way = -span(poses, place)[:3, 3]
    return np.asarray(way / max(float(np.linalg.norm(way)), 1e-12))


def scatter_rad(found: Found, seen: Seen, focal_px: float) -> float:
    """How uncertain the camera's way is, by leaving out one part after another of what is seen.

    Edges that are none in space, or were followed wrongly, agree with one another in a motion of
    their own: of starts 10 to 25 degrees off the residuals said 1 to 2, as of right ones, and
    this 5 to 20.
    """
    best = found.minimum
    way = way_of(best.poses, seen.place)
    squared = 0.0
    for part in range(_PARTS):
        fewer = _without(seen, part)
        left = _adjust(fewer, best.poses, best.idepth, focal_px, _LIMITS_PX[-1])
        if left is None:
            return np.inf
        cosine = float(way @ way_of(left.poses, seen.place))
        squared += float(np.arccos(np.clip(cosine, -1.0, 1.0))) ** 2
    return float(np.sqrt((_PARTS - 1) / _PARTS * squared))


def _without(seen: Seen, part: int) -> Seen:
    """The same less every eighth edge, meeting and direction."""
    ends = 2 * seen.edges
    number = np.arange(seen.visible.shape[1])
    number = np.where(number < ends, number // 2, number - ends)
    visible = np.where(number % _PARTS == part, 0, seen.visible).astype(np.uint8)
    turned = seen.turned
    gone = np.arange(turned.normal.shape[1]) % _PARTS == part
    normal = np.where(gone[:, None], 0.0, turned.normal)
    return seen._replace(visible=visible, turned=turned._replace(normal=normal))


def _minima(seen: Seen, focal_px: float) -> list[Minimum]:
    """Where the most promising guesses lead, best first."""
    flat = np.ones(len(seen.rays))

    def fit_px(state: Minimum) -> float:
        return _fit_px(state, seen, focal_px)

    begun = [
        _adjust(seen, poses, flat, focal_px, _GUESS_LIMIT_PX, _GUESS_ROUNDS)
        for poses in _guesses(seen, focal_px)
    ]
    order = sorted(filter(None, begun), key=fit_px)[:_TAKEN_FURTHER]
    ended = [_settled(seen, state, focal_px) for state in order]
    ahead = [s for s in ended if s is not None and np.mean(s.idepth > 0.0) > _MIN_AHEAD]
    return sorted(ahead, key=fit_px)


def _settled(seen: Seen, state: Minimum | None, focal_px: float) -> Minimum | None:
    """The minimum that a state leads to, with outliers counting less and less."""
    for limit_px in _LIMITS_PX:
        if state is not None:
            state = _adjust(seen, state.poses, state.idepth, focal_px, limit_px)
    return state


def _guesses(seen: Seen, focal_px: float) -> list[list[Mat4]]:
    """Motions to begin with: the camera gone to each side, and turned as everything seems to."""
    known = len(seen.turned.R) > 0
    begun = _as_axes_say(seen) if known else _turned_only(seen, focal_px)
    m, place = len(begun), seen.place
    steps = [k - place if k < place else k - place + 1 for k in range(m)]
    guesses = []
    for direction in _DIRECTIONS:
        poses = []
        for step, T in zip(steps, begun, strict=True):
            t = _GUESSED_BASELINE * step / m * direction
            # Where all motion was taken for a turn, what lies at the middle depth stays in place.
            turn = np.zeros(3) if known else np.array([t[1], -t[0], 0.0])
            poses.append(se3.exp(np.array([*t, *turn])) @ T)
        guesses.append(poses)
    return guesses


def _as_axes_say(seen: Seen) -> list[Mat4]:
    return [se3.from_rotation_translation(R, np.zeros(3)) for R in seen.turned.R]


def _turned_only(seen: Seen, focal_px: float) -> list[Mat4]:
    """Rotations of each frame that explain most, as if all were far away."""
    poses = [np.eye(4) for _ in range(len(seen.line))]
    far = np.zeros(len(seen.rays))
    for _ in range(_TURNS):
        system = _system(seen, poses, far, _TURN_LIMIT_PX / focal_px)
        for k in range(len(poses)):
            at = slice(6 * k + 3, 6 * k + 6)
            H = system.H[at, at]
            step = -np.linalg.solve(H + (1e-9 + 1e-6 * np.trace(H)) * np.eye(3), system.b[at])
            poses[k] = se3.exp(np.array([0.0, 0.0, 0.0, *step])) @ poses[k]
    return poses


def _reversed(seen: Seen, state: Minimum, focal_px: float) -> Minimum | None:
    """The minimum near the same scene as a reversed relief, seen from the other side."""
    mean = float(np.mean(state.idepth))
    poses = [reversed_relief(T, mean) for T in state.poses]
    idepth = np.maximum(2.0 * mean - state.idepth, 0.1 * mean)
    begun = _adjust(seen, poses, idepth, focal_px, _GUESS_LIMIT_PX, _GUESS_ROUNDS)
    found = _settled(seen, begun, focal_px)
    return found if found is not None and np.mean(found.idepth > 0.0) > _MIN_AHEAD else None


def _good(state: Minimum, seen: Seen, focal_px: float) -> Bools:
    """Points (n,) that fit in every frame that sees them."""
    visible = seen.visible > 0
    fits = np.sqrt(state.squared) * focal_px < _OUTLIER_PX
    good = np.all(fits | ~visible, axis=0) & np.any(visible, axis=0) & (state.idepth > 0.0)
    # One end of an edge says nothing of it without the other.
    ends = slice(0, 2 * seen.edges)
    good[ends] = np.repeat(good[ends].reshape(-1, 2).all(axis=1), 2)
    return np.asarray(good)


def _fit_px(state: Minimum, seen: Seen, focal_px: float) -> float:
    """Root mean square of all residuals, those beyond the most and behind the camera at it."""
    squared = np.minimum(state.squared * focal_px**2, _MOST_PX**2)
    squared[:, state.idepth <= 0.0] = _MOST_PX**2
    total = int(seen.visible.sum())
    return float(np.sqrt((seen.visible * squared).sum() / total)) if total > 0 else np.inf


def _system(seen: Seen, poses: Sequence[Mat4], idepth: F64, limit: float = _NO_LIMIT) -> System:
    T, (m, n) = np.stack(poses), seen.visible.shape
    R, t = np.ascontiguousarray(T[:, :3, :3]), np.ascontiguousarray(T[:, :3, 3])
    H, b, W = np.empty((6 * m, 6 * m)), np.empty(6 * m), np.empty((6 * m, n))
    Hd, bd, squared = np.empty(n), np.empty(n), np.empty((m, n))
    seen_by = (seen.rays, idepth, seen.line, seen.visible)
    cost = kl.accumulate(*seen_by, R, t, limit, H, b, Hd, bd, W, squared)
    cost += add_directions(seen.turned.along, seen.turned.normal, R, limit, H, b)
    return System(cost, H, b, W, Hd, bd, squared)


def _adjust(
    seen: Seen,
    poses: Sequence[Mat4],
    idepth: F64,
    focal_px: float,
    limit_px: float,
    rounds: int = _ROUNDS,
) -> Minimum | None:
    T, idepth = np.stack(poses), np.array(idepth)
    R, t = np.ascontiguousarray(T[:, :3, :3]), np.ascontiguousarray(T[:, :3, 3])
    squared = np.empty((len(T), len(idepth)))
    prior = (_PRIOR_PX / _PRIOR_SIGMA / focal_px) ** 2
    seen_by = (seen.rays, seen.line, seen.visible, seen.turned.along, seen.turned.normal)
    cost = descend(*seen_by, limit_px / focal_px, prior, rounds, R, t, idepth, squared)
    if not np.isfinite(cost) or not np.all(np.isfinite(idepth)):
        return None
    ended = [se3.from_rotation_translation(*pose) for pose in zip(R, t, strict=True)]
    return Minimum(ended, idepth, squared)


def _information(system: System, scale: float) -> F64:
    """What is known of the poses (6 m, 6 m) whatever the depths, motions being `scale` as long."""
    inverse = np.where(system.Hd > 0.0, 1.0 / np.maximum(system.Hd, 1e-12), 0.0)
    S = system.H - (system.W * inverse) @ system.W.T
    length = np.tile([scale, scale, scale, 1.0, 1.0, 1.0], len(S) // 6)
    return np.asarray(S / length[:, None] / length[None, :])
