# SPDX-License-Identifier: Apache-2.0
"""What an image tells of the camera's turn while its rows were read.

A rolling shutter's fast turn shears the image, and a pose takes that for a step aside: in a robot's
turn fixes were off by 12 cm, all alike, at a sigma of 1 cm. But what is left over has the pattern
of a turn. Those in which it is found are looked for again without it.
"""

from typing import NamedTuple

import numpy as np

from edge.geometry.camera import CameraModel
from edge.relocalise.assessment import Solution
from edge.relocalise.calibration import ALIKE, left_over
from edge.relocalise.correspondences import Correspondences
from edge.types import F64, Mat6

_POSE, _TURN = slice(0, 6), slice(6, 9)
# Beforehand: a turn of 1 rad/s and a walk of a depth in 3 s, over 30 ms; a lens that is calibrated.
_TURN_RAD, _SHIFT_DEPTHS, _LENS_SHARE = 0.03, 0.01, 0.003
_PRIOR = np.repeat((0.0, _TURN_RAD**-2, _SHIFT_DEPTHS**-2, _LENS_SHARE**-2), (6, 3, 3, 2))


class RowsEvidence(NamedTuple):
    """How far the camera turned while the rows of an image were read, by its matches."""

    turned_rad: F64  # (3,) its own axes
    chi2: float  # of that against no turn at all: 3 degrees of freedom
    doubt: Mat6  # covariance of the pose by what is not known of the turn; map axes


def evidence(
    solution: Solution, matches: Correspondences, camera: CameraModel
) -> RowsEvidence | None:
    """What the inliers of a solution tell of the turn, whatever the pose and the lens."""
    A, r, weight, R = left_over(solution, matches, camera)
    try:
        flat = np.linalg.solve((A * weight[:, None]).T @ A + np.diag(_PRIOR), A.T @ (weight * r))
        chi2 = float(weight @ (r - A @ flat) ** 2) / max(len(r) - len(flat), 1)
        each = ALIKE * max(chi2, 1.0)
        H = (A * weight[:, None]).T @ A / each + np.diag(_PRIOR)
        found = np.asarray(np.linalg.solve(H, A.T @ (weight * r) / each)[_TURN], np.float64)
        C = np.linalg.inv(H)[_TURN, _TURN]
        by_turn = np.linalg.solve(H[_POSE, _POSE], H[_POSE, _TURN])
        by_turn = np.vstack((R @ by_turn[:3], R @ by_turn[3:]))
        against_none = float(found @ np.linalg.solve(C, found))
        told = RowsEvidence(found, against_none, by_turn @ C @ by_turn.T)
    except np.linalg.LinAlgError:
        return None
    return told if all(np.all(np.isfinite(part)) for part in told) else None
