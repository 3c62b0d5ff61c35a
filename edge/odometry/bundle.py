# SPDX-License-Identifier: Apache-2.0
"""Bundle adjustment of the few frames of a start, whatever is seen of its points.

The reference frame is fixed; unknown are the other frames' T_frame_reference and the points'
inverse depths in the reference.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from edge.geometry import se3
from edge.types import F64, Mat4

# Two motions go the same way if they point less than 30 degrees apart.
_SAME_COSINE = 0.87
NO_HUBER = 1e9


class System(NamedTuple):
    """Gauss-Newton system of m frames and n points."""

    cost: float
    H: F64  # (6 m, 6 m), block diagonal
    b: F64  # (6 m,)
    W: F64  # (6 m, n)
    Hd: F64  # (n,)
    bd: F64  # (n,)
    squared: F64  # (m, n) squared residuals


class State(NamedTuple):
    """Where a descent has come to."""

    poses: list[Mat4]
    idepth: F64
    system: System


SystemAt = Callable[[Sequence[Mat4], F64], System]


def descend(system_at: SystemAt, poses: Sequence[Mat4], idepth: F64, rounds: int) -> State | None:
    """Levenberg-Marquardt over poses and inverse depths; None where it breaks down."""
    poses, now, damping = list(poses), system_at(poses, idepth), 1e-3
    for _ in range(rounds):
        inverse = 1.0 / (now.Hd * (1.0 + damping) + 1e-12)
        S = now.H - (now.W * inverse) @ now.W.T
        S[np.diag_indices_from(S)] += damping * np.diag(now.H) + 1e-12
        try:
            dx = -np.linalg.solve(S, now.b - now.W @ (inverse * now.bd))
        except np.linalg.LinAlgError:
            return None
        step = -inverse * (now.bd + now.W.T @ dx)
        trial_poses = [se3.exp(dx[6 * k : 6 * k + 6]) @ T for k, T in enumerate(poses)]
        trial = system_at(trial_poses, idepth + step)
        if trial.cost < now.cost:
            done = now.cost - trial.cost < 1e-6 * now.cost
            poses, idepth, now = trial_poses, idepth + step, trial
            damping = max(damping * 0.2, 1e-9)
            if done:
                break
        else:
            damping *= 10.0
            if damping > 1e3:
                break
    return State(poses, idepth, now) if np.all(np.isfinite(idepth)) else None


def depth_sigma(system: System, poses: Sequence[Mat4], sigma: float) -> F64:
    """Standard deviations (n,) of the inverse depths, poses uncertain too, scale held.

    system  without a robust kernel
    sigma   of a residual
    """
    inverse = np.where(system.Hd > 0.0, 1.0 / np.maximum(system.Hd, 1e-12), 0.0)
    S = system.H - (system.W * inverse) @ system.W.T
    # Scaling all translations (and depths with them) changes no image: hold it.
    gauge = np.zeros(len(S))
    for k, T in enumerate(poses):
        gauge[6 * k : 6 * k + 3] = T[:3, 3]
    gauge /= max(float(np.linalg.norm(gauge)), 1e-12)
    S += np.outer(gauge, gauge) * float(np.trace(S))
    covariance = np.linalg.pinv(S, rcond=1e-14)
    carried = system.W * inverse
    variance = inverse + np.einsum("in,ij,jn->n", carried, covariance, carried)
    return np.asarray(sigma * np.sqrt(np.maximum(variance, 0.0)))


def rescaled(poses: Sequence[Mat4], scale: float) -> tuple[Mat4, ...]:
    """The same motions `scale` times as long."""
    out = []
    for T in poses:
        T = T.copy()
        T[:3, 3] *= scale
        out.append(T)
    return tuple(out)


def reversed_relief(T: Mat4, mean: float) -> Mat4:
    """The motion that shows nearly the same of a scene whose near and far are exchanged.

    mean  inverse depth about which they are
    """
    t = T[:3, 3]
    rival = se3.exp(np.array([0.0, 0.0, 0.0, -2.0 * mean * t[1], 2.0 * mean * t[0], 0.0])) @ T
    rival[:3, 3] = -t
    return rival


def goes_the_same_way(a: Mat4, b: Mat4) -> bool:
    """Whether two motions point less than 30 degrees apart."""
    s, t = a[:3, 3], b[:3, 3]
    return bool(s @ t > _SAME_COSINE * np.linalg.norm(s) * np.linalg.norm(t))
