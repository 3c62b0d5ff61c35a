# SPDX-License-Identifier: Apache-2.0
"""How much an odometry drifts, told by how well its recent fixes agree."""

from typing import NamedTuple

import numpy as np

from edge.registration.fields import ROWS
from edge.types import F64

# In times of the configuration: cameras differ thirtyfold, a rolling shutter bends what a global
# one keeps. Each is as likely as it explains the fixes.
FACTORS = np.array([0.05, 0.1, 0.2, 0.4, 0.8, 1.6])
# No drive of 29 drifted by more than 0.7; fixes of a few centimetres' way tell little of so small
# factors as most of a global shutter's were, so they need many.
FIRST_WEIGHTS = np.array([0.005, 0.01, 0.05, 0.635, 0.28, 0.02])
_TRUST = 0.2  # in a likelihood: fixes tell less than they seem to
# What is known without any fix: the scale to a factor of e.
KNOWN = np.diag([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])


class System(NamedTuple):
    """Equations of m rows for pose and scale of one frame."""

    residual: F64  # (m,)
    J: F64  # (m, 7)
    noise: F64  # (m, m) of the fixes
    drift: F64  # (m, m) of the odometry by a factor of 1


def weighed(system: System) -> F64:
    """Weights of FACTORS by the restricted likelihood of the fixes."""
    log_weights = np.log(FIRST_WEIGHTS)
    columns = np.column_stack((system.J, system.residual))
    for n, factor in enumerate(FACTORS):
        root = np.linalg.cholesky(system.noise + factor**2 * system.drift)
        white = np.linalg.solve(root, columns)
        squares = white.T @ white
        H, b = squares[:ROWS, :ROWS] + KNOWN, squares[:ROWS, ROWS]
        square = float(squares[ROWS, ROWS] - b @ np.linalg.solve(H, b))
        logs = 2.0 * float(np.log(np.diag(root)).sum()) + float(np.linalg.slogdet(H)[1])
        log_weights[n] -= _TRUST * 0.5 * (square + logs)
    weights = np.exp(log_weights - log_weights.max())
    return np.asarray(weights / weights.sum(), np.float64)
