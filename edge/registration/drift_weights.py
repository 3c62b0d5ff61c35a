# SPDX-License-Identifier: Apache-2.0
"""How much an odometry drifts, told by how well its recent fixes agree."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edge.registration.fields import ROWS
from edge.types import F64

# In times of the configuration: cameras differ thirtyfold, a rolling shutter bends what a global
# one keeps. Each is as likely as it explains the fixes.
FACTORS = np.array([0.05, 0.1, 0.2, 0.4, 0.8, 1.6])
# No drive of 29 drifted by more than 0.7; fixes of a few centimetres' way tell little of so small
# factors as most of a global shutter's were, so they need many.
FIRST_WEIGHTS = np.array([[0.005, 0.01, 0.05, 0.635, 0.28, 0.02]] * 2)
# In a likelihood: fixes tell less than they seem to. Of 40 drives in maps good and poor errors and
# published sigmas were most alike so: the logarithm of NEES varies by 0.6.
_TRUST = 0.5
_LARGE = 1e300
# What is known without any fix: the scale to a factor of e.
KNOWN = np.diag([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])


class Drift(NamedTuple):
    """How much an odometry drifts, in times of the configuration."""

    shift: float  # of positions
    bend: float  # of rotation and scale


class System(NamedTuple):
    """Equations of m rows for pose and scale of one frame."""

    residual: F64  # (m,)
    J: F64  # (m, 7)
    noise: F64  # (m, m) of the fixes
    drift: F64  # (2, m, m) of the odometry, by the parts of Drift at factors of 1

    def only(self, used: NDArray[np.bool_]) -> "System":
        """The rows `used` (m,)."""
        both = np.ix_(used, used)
        drift = np.stack([part[both] for part in self.drift])
        return System(self.residual[used], self.J[used], self.noise[both], drift)

    def sigma(self, variance_factors: F64) -> F64:
        """Covariance (m, m) at the factors (2,) of the drift's variances."""
        return np.asarray(self.noise + np.tensordot(variance_factors, self.drift, 1))


def weighed(system: System, weights: F64) -> F64:
    """Weights (2, k) of FACTORS for each part of the drift, by the restricted likelihood of fixes.

    One part after the other, at the mean variance of the other's: the full grid costs k times
    as much.
    """
    weights = weights.copy()
    bordered = _bordered(np.column_stack((system.J, system.residual)))
    for part in (1, 0):
        other = system.noise + (weights[1 - part] @ FACTORS**2) * system.drift[1 - part]
        log_weights = np.log(FIRST_WEIGHTS[part])
        for n, factor in enumerate(FACTORS):
            likelihood = _log_likelihood(other + factor**2 * system.drift[part], bordered)
            log_weights[n] += _TRUST * likelihood
        weights[part] = np.exp(log_weights - log_weights.max())
        weights[part] /= weights[part].sum()
    return weights


def _bordered(columns: F64) -> F64:
    """Matrix (m + 8, m + 8) with a covariance (m, m) still to be set, and `columns` (m, 8) beside.

    Of its Cholesky root the part below is those columns whitened: cheaper than solving for them.
    The corner takes no part, it only has to be large.
    """
    m, k = columns.shape
    bordered = np.zeros((m + k, m + k))
    bordered[m:, :m] = columns.T
    bordered[m:, m:] = np.diag(np.full(k, _LARGE))
    return bordered


def _log_likelihood(sigma: F64, bordered: F64) -> float:
    """Restricted: of residuals, the last of the columns, whatever the 7 unknowns are."""
    m = len(sigma)
    bordered[:m, :m] = sigma
    root = np.linalg.cholesky(bordered)  # of the lower triangle
    squares = root[m:, :m] @ root[m:, :m].T
    H, b = squares[:ROWS, :ROWS] + KNOWN, squares[:ROWS, ROWS]
    square = float(squares[ROWS, ROWS] - b @ np.linalg.solve(H, b))
    logs = 2.0 * float(np.log(np.diag(root)[:m]).sum()) + float(np.linalg.slogdet(H)[1])
    return -0.5 * (square + logs)
