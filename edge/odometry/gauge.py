# SPDX-License-Identifier: Apache-2.0
"""What images cannot see of a window, and what they say of the rest."""

from collections.abc import Sequence

import numpy as np

from edge.geometry import se3
from edge.odometry.system import FrameState
from edge.types import F64, Mat6


def null_directions(keyframes: Sequence[FrameState]) -> F64:
    """Directions (8 f, 7) that no image can see: position, orientation, scale of the whole."""
    N = np.zeros((8 * len(keyframes), 7))
    for i, keyframe in enumerate(keyframes):
        T = keyframe.T_first
        N[8 * i : 8 * i + 6, :6] = se3.adjoint(T)
        N[8 * i : 8 * i + 3, 6] = T[:3, 3]
    return np.asarray(N / np.maximum(np.linalg.norm(N, axis=0), 1e-12))


def path_length(keyframes: Sequence[FrameState]) -> float:
    """From the first keyframe's place by all others' to the last one's."""
    centres = np.stack([se3.inverse(k.T_cam_odom)[:3, 3] for k in keyframes])
    return float(np.linalg.norm(np.diff(centres, axis=0), axis=1).sum())


def from_newest(keyframes: Sequence[FrameState]) -> F64:
    """Places of all cameras (f, 3) in that of the last one."""
    T = keyframes[-1].T_cam_odom
    return np.stack([(T @ se3.inverse(k.T_cam_odom))[:3, 3] for k in keyframes])


class SeenSystem:
    """Solves with the frames' information H (8 f, 8 f) in the directions that images can see.

    The window as a whole, and its scale, are held fixed.
    """

    def __init__(self, H: F64, keyframes: Sequence[FrameState]) -> None:
        Q, _ = np.linalg.qr(null_directions(keyframes))
        self._seen = np.eye(len(H)) - Q @ Q.T
        self._size = 1.0 / np.sqrt(np.maximum(np.diag(H), 0.0) + 10.0)
        # With the unseen directions made stiff, the inverse is that on the seen ones.
        stiff = self._seen @ H @ self._seen + float(np.max(np.diag(H))) * (Q @ Q.T)
        # Rounding in float32 sums can leave a weak direction slightly negative; this exceeds it.
        scaled = stiff * self._size[:, None] * self._size[None, :]
        self._scaled = scaled + 1e-6 * np.eye(len(H))

    def form(self, left: F64, right: F64) -> F64:
        """Values left (m, 8 f) H^-1 right (8 f, n)."""
        left = (left @ self._seen) * self._size
        right = self._size[:, None] * (self._seen @ right)
        return np.asarray(left @ np.linalg.solve(self._scaled, right))


def relative_covariance(
    seen: SeenSystem, keyframes: Sequence[FrameState], variance: float
) -> Mat6 | None:
    """Covariance (6, 6) of the newest keyframe's T_newest_previous, as a twist on its left.

    `seen` holds the window's information without its depths, `variance` is that
    of a residual of weight one [grey^2]. None where too little holds the window.
    """
    previous, newest = keyframes[-2], keyframes[-1]
    J = np.zeros((6, 8 * len(keyframes)))
    T_newest_previous = newest.T_first @ se3.inverse(previous.T_first)
    J[:, -16:-10] = -se3.adjoint(T_newest_previous)
    J[:, -8:-2] = np.eye(6)
    covariance = variance * seen.form(J, J.T)
    if not np.all(np.isfinite(covariance)):
        return None
    values, vectors = np.linalg.eigh(0.5 * (covariance + covariance.T))
    # What rounding still left at or below zero is as good as the rest, not better.
    values = np.maximum(values, 1e-6 * values[-1])
    return np.asarray((vectors * values) @ vectors.T)
