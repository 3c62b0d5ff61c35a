# SPDX-License-Identifier: Apache-2.0
"""What a start knows of its poses, kept in the first window beside what its images say.

Edges alone hold a window loosely: what held them against one another at the start (where they
meet, how they run) is known to the start only.
"""

from collections.abc import Sequence

import numpy as np

from edge.geometry import se3
from edge.odometry.anchors import RESIDUAL_VARIANCE_GREY2
from edge.odometry.prior import MarginalPrior
from edge.odometry.system import FrameState
from edge.types import F64, Mat4

# Variance beyond what the start's residuals say: the same edges show in all of its frames.
_INFLATION = 4.0


def of_all_frames(information: F64, T_frame_reference: Sequence[Mat4], place: int) -> F64:
    """Information (6 n, 6 n) of all frames' poses from that of all but the reference, at `place`.

    information        (6 n - 6, 6 n - 6)  of twists on the left of T_frame_reference
    T_frame_reference  n of them, the reference's own among them
    """
    n = len(T_frame_reference)
    J = np.zeros((6 * n - 6, 6 * n))
    for row, k in enumerate(k for k in range(n) if k != place):
        J[6 * row : 6 * row + 6, 6 * k : 6 * k + 6] = np.eye(6)
        J[6 * row : 6 * row + 6, 6 * place : 6 * place + 6] = -se3.adjoint(T_frame_reference[k])
    return J.T @ information @ J


def hold(
    prior: MarginalPrior, keyframes: Sequence[FrameState], information: F64, frames: Sequence[int]
) -> None:
    """Let keyframes, of a start's frames those of these numbers, keep what it knew."""
    kept = np.concatenate([np.arange(6 * k, 6 * k + 6) for k in frames])
    gone = np.setdiff1d(np.arange(len(information)), kept)
    carry = information[np.ix_(kept, gone)] @ np.linalg.pinv(
        information[np.ix_(gone, gone)], 1e-12, hermitian=True
    )
    held = information[np.ix_(kept, kept)] - carry @ information[np.ix_(gone, kept)]
    poses = np.concatenate([np.arange(8 * k, 8 * k + 6) for k in range(len(frames))])
    H = np.zeros_like(prior.H)
    H[np.ix_(poses, poses)] = RESIDUAL_VARIANCE_GREY2 / _INFLATION * held
    prior.add(H, np.zeros(len(H)), keyframes)
