# SPDX-License-Identifier: Apache-2.0
"""How far off a covariance lets something be, as one number."""

import math

import numpy as np

from edge.types import F64, Mat6


def position_sigma(covariance: Mat6) -> float:
    """Standard deviation of a pose's position along its worst direction, in its unit of length."""
    return largest_sigma(covariance[:3, :3])


def rotation_sigma(covariance: Mat6) -> float:
    """Standard deviation [rad] of a pose's rotation about its worst axis."""
    return largest_sigma(covariance[3:, 3:])


def largest_sigma(block: F64) -> float:
    """Standard deviation along the worst direction of a covariance (n, n).

    Infinite where it holds what is no number, or has no positive direction without being zero:
    whoever compares it with a bound then trusts nothing that broke down on the way.
    """
    if not np.isfinite(block).all():
        return math.inf
    variance = float(np.linalg.eigvalsh(block)[-1])
    return math.sqrt(variance) if variance >= 0.0 else math.inf
