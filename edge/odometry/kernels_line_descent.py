# SPDX-License-Identifier: Apache-2.0
"""Bundle adjustment of edges in one go: a start tries it from many guesses."""

import numpy as np

from edge.geometry.kernels import exp_times, solve_symmetric
from edge.kernel import kernel
from edge.odometry.kernels_line_start import accumulate
from edge.types import F64, U8

_TINY = 1e-12
_DONE_SHARE, _MAX_DAMPING = 1e-6, 1e3


@kernel
def descend(
    rays: F64,
    line: F64,
    seen: U8,
    along: F64,
    normal: F64,
    limit: float,
    prior: float,
    rounds: int,
    R: F64,
    t: F64,
    idepth: F64,
    squared: F64,
) -> float:
    """Levenberg-Marquardt over poses and inverse depths; the robust cost it ends with.

    rays, line, seen, limit    as in `kernels_line_start.accumulate`
    along      (k, 3)     float64  directions in space of some edges, in the reference
    normal     (m, k, 3)  float64  of their planes in the frames, as long as it is certain; or zeros
    prior      information that each inverse depth is one: for those that nothing else tells
    R, t       (m, 3, 3), (m, 3)  float64, in and out  T_frame_reference
    idepth     (n,)    float64, in and out
    squared    (m, n)  float64, out: squared residuals

    Infinite where it breaks down.
    """
    m, n = seen.shape
    now, then = _room(m, n), _room(m, n)
    S, right, dx = np.empty((6 * m, 6 * m)), np.empty(6 * m), np.empty(6 * m)
    inverse = np.empty(n)
    R_trial, t_trial, trial = np.empty_like(R), np.empty_like(t), np.empty_like(idepth)
    cost = accumulate(rays, idepth, line, seen, R, t, limit, *now) + _prefer_one(idepth, prior, now)
    cost += add_directions(along, normal, R, limit, now[0], now[1])
    damping = 1e-3
    for _ in range(rounds):
        for r in range(6 * m):
            right[r] = -now[1][r]
            for c in range(r + 1):
                S[r, c] = now[0][r, c]
            S[r, r] += damping * S[r, r] + _TINY
        _eliminate(now, damping, inverse, S, right)
        if not solve_symmetric(S, right, dx):
            return np.inf
        for f in range(m):
            exp_times(dx[6 * f : 6 * f + 6], R[f], t[f], R_trial[f], t_trial[f])
        _step(now, inverse, dx, idepth, trial)
        new = accumulate(rays, trial, line, seen, R_trial, t_trial, limit, *then)
        new += _prefer_one(trial, prior, then)
        new += add_directions(along, normal, R_trial, limit, then[0], then[1])
        if new < cost:
            done = cost - new < _DONE_SHARE * cost
            R[:], t[:], idepth[:], cost = R_trial, t_trial, trial, new
            now, then = then, now
            damping = max(damping * 0.2, 1e-9)
            if done:
                break
        else:
            damping *= 10.0
            if damping > _MAX_DAMPING:
                break
    squared[:] = now[5]
    return cost


@kernel
def add_directions(along: F64, normal: F64, R: F64, limit: float, H: F64, b: F64) -> float:
    """Add to a system that edges of known direction lie in their planes; the cost of it."""
    cost, far = 0.0, 1.0 / (limit * limit)
    v, J = np.empty(3), np.empty(3)
    for m in range(normal.shape[0]):
        for i in range(along.shape[0]):
            r = 0.0
            for j in range(3):
                v[j] = (
                    R[m, j, 0] * along[i, 0] + R[m, j, 1] * along[i, 1] + R[m, j, 2] * along[i, 2]
                )
                r += normal[m, i, j] * v[j]
            w = 1.0 / (1.0 + r * r * far)
            cost += r * r * w
            w *= w
            J[0] = v[1] * normal[m, i, 2] - v[2] * normal[m, i, 1]
            J[1] = v[2] * normal[m, i, 0] - v[0] * normal[m, i, 2]
            J[2] = v[0] * normal[m, i, 1] - v[1] * normal[m, i, 0]
            for j in range(3):
                b[6 * m + 3 + j] += w * J[j] * r
                for k in range(3):
                    H[6 * m + 3 + j, 6 * m + 3 + k] += w * J[j] * J[k]
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
