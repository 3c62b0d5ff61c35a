# SPDX-License-Identifier: Apache-2.0
"""Bundle adjustment of corners and edges in one go: a start tries it from many guesses."""

import numpy as np

from edge.geometry.kernels import exp_times, solve_symmetric
from edge.kernel import kernel
from edge.odometry.kernels_line_start import accumulate as accumulate_edges
from edge.odometry.kernels_start import accumulate as accumulate_corners
from edge.types import F64, U8

_TINY = 1e-12
_DONE_SHARE, _MAX_DAMPING = 1e-6, 1e3


@kernel
def descend(
    corner: F64,
    corner_at: F64,
    corner_seen: U8,
    end: F64,
    line: F64,
    line_seen: U8,
    corner_worth: float,
    huber: float,
    prior: float,
    rounds: int,
    R: F64,
    t: F64,
    idepth: F64,
    squared: F64,
) -> float:
    """Levenberg-Marquardt over poses and inverse depths; the Huber cost it ends with.

    corner, corner_at, corner_seen    as in `kernels_start.accumulate`
    end, line, line_seen              as in `kernels_line_start.accumulate`
    corner_worth  what squared distances of corners count of those of edges
    prior      information that each inverse depth is one: for those that nothing else tells
    R, t       (m, 3, 3), (m, 3)  float64, in and out  T_frame_reference
    idepth     (n + k,)    float64, in and out, corners first
    squared    (m, n + k)  float64, out: squared residuals

    Infinite where it breaks down.
    """
    m, n, k = line.shape[0], corner.shape[0], end.shape[0]
    near, far = _room(m, n), _room(m, k)
    near_trial, far_trial = _room(m, n), _room(m, k)
    S, right, dx = np.empty((6 * m, 6 * m)), np.empty(6 * m), np.empty(6 * m)
    inverse = np.empty(n + k)
    R_trial, t_trial, trial = np.empty_like(R), np.empty_like(t), np.empty_like(idepth)
    cost = _corners(corner, corner_at, corner_seen, R, t, idepth[:n], huber, corner_worth, near)
    cost += accumulate_edges(end, idepth[n:], line, line_seen, R, t, huber, *far)
    cost += _prefer_one(idepth[:n], prior, near) + _prefer_one(idepth[n:], prior, far)
    damping = 1e-3
    for _ in range(rounds):
        for r in range(6 * m):
            right[r] = -near[1][r] - far[1][r]
            for c in range(r + 1):
                S[r, c] = near[0][r, c] + far[0][r, c]
            S[r, r] += damping * S[r, r] + _TINY
        _eliminate(near, damping, inverse[:n], S, right)
        _eliminate(far, damping, inverse[n:], S, right)
        if not solve_symmetric(S, right, dx):
            return np.inf
        for f in range(m):
            exp_times(dx[6 * f : 6 * f + 6], R[f], t[f], R_trial[f], t_trial[f])
        _step(near, inverse[:n], dx, idepth[:n], trial[:n])
        _step(far, inverse[n:], dx, idepth[n:], trial[n:])
        new = _corners(
            corner, corner_at, corner_seen, R_trial, t_trial, trial[:n], huber,
            corner_worth, near_trial,
        )  # fmt: skip
        new += accumulate_edges(
            end, trial[n:], line, line_seen, R_trial, t_trial, huber, *far_trial
        )
        new += _prefer_one(trial[:n], prior, near_trial) + _prefer_one(trial[n:], prior, far_trial)
        if new < cost:
            done = cost - new < _DONE_SHARE * cost
            R[:], t[:], idepth[:], cost = R_trial, t_trial, trial, new
            near, near_trial, far, far_trial = near_trial, near, far_trial, far
            damping = max(damping * 0.2, 1e-9)
            if done:
                break
        else:
            damping *= 10.0
            if damping > _MAX_DAMPING:
                break
    squared[:, :n], squared[:, n:] = near[5], far[5]
    return cost


@kernel
def _room(m: int, n: int) -> tuple[F64, F64, F64, F64, F64, F64]:
    """H, b, Hd, bd, W and squared residuals of `accumulate`, for m frames and n points."""
    return (
        np.zeros((6 * m, 6 * m)),
        np.zeros(6 * m),
        np.zeros(n),
        np.zeros(n),
        np.zeros((6 * m, n)),
        np.zeros((m, n)),
    )


@kernel
def _corners(
    rays: F64,
    at: F64,
    seen: U8,
    R: F64,
    t: F64,
    idepth: F64,
    huber: float,
    worth: float,
    out: tuple[F64, F64, F64, F64, F64, F64],
) -> float:
    """Set `out` to the system of corners, each worth so much of an edge's end; their cost."""
    cost = accumulate_corners(rays, idepth, at, seen, R, t, huber, *out)
    H, b, Hd, bd, W, _ = out
    H *= worth
    b *= worth
    Hd *= worth
    bd *= worth
    W *= worth
    return cost * worth


@kernel
def _prefer_one(idepth: F64, prior: float, out: tuple[F64, F64, F64, F64, F64, F64]) -> float:
    """Add to a system that inverse depths are about one; the cost of it."""
    Hd, bd = out[2], out[3]
    cost = 0.0
    for i in range(idepth.shape[0]):
        off = idepth[i] - 1.0
        Hd[i] += prior
        bd[i] += prior * off
        cost += prior * off * off
    return cost


@kernel
def _eliminate(
    system: tuple[F64, F64, F64, F64, F64, F64],
    damping: float,
    inverse: F64,
    S: F64,
    right: F64,
) -> None:
    """Take depths out of the lower triangle of S and the right side; set `inverse` of each."""
    Hd, bd, W = system[2], system[3], system[4]
    n = Hd.shape[0]
    for i in range(n):
        inverse[i] = 1.0 / (Hd[i] * (1.0 + damping) + _TINY)
    for r in range(S.shape[0]):
        total = 0.0
        for i in range(n):
            total += W[r, i] * inverse[i] * bd[i]
        right[r] += total
        for c in range(r + 1):
            total = 0.0
            for i in range(n):
                total += W[r, i] * inverse[i] * W[c, i]
            S[r, c] -= total


@kernel
def _step(
    system: tuple[F64, F64, F64, F64, F64, F64],
    inverse: F64,
    dx: F64,
    idepth: F64,
    out: F64,
) -> None:
    """Set `out` to the inverse depths after the step dx of the poses."""
    bd, W = system[3], system[4]
    for i in range(idepth.shape[0]):
        total = bd[i]
        for r in range(dx.shape[0]):
            total += W[r, i] * dx[r]
        out[i] = idepth[i] - inverse[i] * total
