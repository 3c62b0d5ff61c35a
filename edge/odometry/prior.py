# SPDX-License-Identifier: Apache-2.0
"""What marginalised points and keyframes leave behind in the window."""

from collections.abc import Sequence

import numpy as np

from edge.odometry.system import FrameState
from edge.types import F64


class MarginalPrior:
    """Quadratic energy on the frames' states, left by what was marginalised.

    H (8 f, 8 f) and b (8 f,), the gradient half at the first estimates.
    """

    def __init__(self, n_frames: int = 0) -> None:
        self.H: F64 = np.zeros((8 * n_frames, 8 * n_frames))
        self.b: F64 = np.zeros(8 * n_frames)

    @property
    def is_empty(self) -> bool:
        """Whether nothing was marginalised yet."""
        return not np.any(self.H)

    def grow(self) -> None:
        """Make room for one more frame at the end."""
        n = len(self.b)
        H = np.zeros((n + 8, n + 8))
        H[:n, :n] = self.H
        self.H, self.b = H, np.concatenate((self.b, np.zeros(8)))

    def energy(self, keyframes: Sequence[FrameState]) -> float:
        """Energy at the current state, up to a constant."""
        delta = np.concatenate([k.delta for k in keyframes])
        return float(delta @ self.H @ delta + 2.0 * self.b @ delta)

    def gradient(self, keyframes: Sequence[FrameState]) -> F64:
        """Half of the energy's gradient at the current state."""
        delta = np.concatenate([k.delta for k in keyframes])
        return np.asarray(self.b + self.H @ delta)

    def add(self, H: F64, b_now: F64, keyframes: Sequence[FrameState]) -> None:
        """Add a term whose gradient half at the current state is `b_now`, if it is a number."""
        if not (np.isfinite(H).all() and np.isfinite(b_now).all()):
            return
        delta = np.concatenate([k.delta for k in keyframes])
        self.H = self.H + 0.5 * (H + H.T)
        self.b = self.b + b_now - H @ delta

    def rebase(self, keyframes: Sequence[FrameState], index: int) -> None:
        """Take a frame's current state as its first estimate."""
        at = slice(8 * index, 8 * index + 8)
        self.b = self.b + self.H[:, at] @ keyframes[index].delta
        keyframes[index].rebase()

    def eliminate(self, index: int) -> None:
        """Marginalise one frame: Schur complement over its 8 unknowns."""
        gone = np.arange(8 * index, 8 * index + 8)
        kept = np.setdiff1d(np.arange(len(self.b)), gone)
        # Rounding in float32 sums can leave a frame that little holds slightly negative.
        size = 1.0 / np.sqrt(np.maximum(np.diag(self.H), 0.0) + 10.0)
        H = self.H * size[:, None] * size[None, :]
        b = self.b * size
        inverse = np.linalg.pinv(0.5 * (H[np.ix_(gone, gone)] + H[np.ix_(gone, gone)].T), 1e-12)
        carry = H[np.ix_(kept, gone)] @ inverse
        H_kept = H[np.ix_(kept, kept)] - carry @ H[np.ix_(gone, kept)]
        b_kept = b[kept] - carry @ b[gone]
        scale = 1.0 / size[kept]
        self.H = 0.5 * (H_kept + H_kept.T) * scale[:, None] * scale[None, :]
        self.b = b_kept * scale
