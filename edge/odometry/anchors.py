# SPDX-License-Identifier: Apache-2.0
"""Inverse depths that the map tells of points of the window, beside what images tell of them."""

import numpy as np

from edge.types import F32

# Variance [grey^2] of a photometric residual of weight one, neighbours' common errors included:
# what makes an inverse depth of known sigma comparable with residuals.
RESIDUAL_VARIANCE_GREY2 = 60.0
# Beyond so many sigmas the map is wrong here, or the point is another one: it pulls no harder.
HUBER_SIGMAS = 2.0


def information_of(sigma: F32) -> F32:
    """Information of inverse depths with standard deviations `sigma` (n,), as residuals have it."""
    return np.asarray(np.float32(RESIDUAL_VARIANCE_GREY2) / np.maximum(sigma, 1e-9) ** 2)


def add(anchor: F32, idepth: F32, Hd: F32, bd: F32) -> float:
    """Add anchors (2, n) to the equations of inverse depths (n,), in place; their energy."""
    target, information = anchor
    if not np.any(information):
        return 0.0
    off = idepth - target
    sigmas = np.abs(off) * np.sqrt(information / np.float32(RESIDUAL_VARIANCE_GREY2))
    robust = np.minimum(1.0, HUBER_SIGMAS / np.maximum(sigmas, 1e-6)).astype(np.float32)
    weight = robust * information
    Hd += weight
    bd += weight * off
    return float(np.sum(weight * off * off * (np.float32(2.0) - robust), dtype=np.float64))
