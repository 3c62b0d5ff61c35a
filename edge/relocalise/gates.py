# SPDX-License-Identifier: Apache-2.0
"""Whether a pose is believed: by its covariance and by what is seen, not by a count."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edge.config.relocalise import RelocaliseConfig
from edge.geometry.covariance import position_sigma, rotation_sigma
from edge.relocalise.assessment import Solution
from edge.types import F32, F64, Pinhole

Bools = NDArray[np.bool_]


class Seen(NamedTuple):
    """How much of what should be seen from a pose is seen; each is a share of 0 to 1."""

    points: float  # of the map's points that should appear, those that fit
    cells: float  # of the image's cells with many such points, those where more fit than by chance
    fitting: float  # of the matches near projections, those that fit

    @property
    def evidence(self) -> float:
        """All three at once: a wrong pose may rest on one poster, but not on all it should see."""
        return self.points * self.cells * self.fitting


# Reasons against a pose that is right as far as it goes.
UNCERTAIN = ("inliers in a corner of the image", "position uncertain", "rotation uncertain")


def why_not(
    solution: Solution, seen: Seen, config: RelocaliseConfig, *, foretold: bool = False
) -> str:
    """Return 'ok', or the first reason against the solution.

    A pose that was `foretold` by a prior has less to prove: it may be less certain, since it is
    weighed by its covariance, and need not be held by all of the image.
    """
    corner, position, rotation = UNCERTAIN
    if np.count_nonzero(solution.inlier) < config.min_inliers:
        return "few inliers"
    narrow = solution.cells < config.min_cells or solution.spread < config.min_spread
    if narrow and not foretold:
        return corner
    slack = config.foretold_slack if foretold else 1.0
    sigma_m = position_sigma(solution.covariance)
    if sigma_m > slack * config.max_sigma_depth_share * solution.depth_m:
        return position
    if rotation_sigma(solution.covariance) > slack * math.radians(config.max_sigma_deg):
        return rotation
    if seen.evidence < config.min_evidence:
        return "little of what should be seen is seen"
    return "ok"


def seen_from(
    expected: F64, found: F32, fits: Bools, chance: float, camera: Pinhole, config: RelocaliseConfig
) -> Seen:
    """Compare what should be seen with what is.

    expected  (n, 2)  float64  projections of the points that should appear
    found     (m, 2)  float32  features matched near projections
    fits      (m,)    bool     those that agree with the pose
    chance    matches per point where the projections are shifted to where they do not belong
    """
    n_expected = _count_in_cells(expected, camera, config)
    n_seen = _count_in_cells(found[fits], camera, config)
    much = n_expected >= config.expected_in_cell
    by_chance = _FITTING_BY_CHANCE * chance * n_expected
    beyond = n_seen > np.maximum(1.0, by_chance + 2.0 * np.sqrt(by_chance))
    return Seen(
        float(fits.sum()) / max(len(expected), 1),
        float((much & beyond).sum()) / max(float(much.sum()), 1.0),
        float(fits.sum()) / max(len(found), 1),
    )


# Of the matches that chance puts near projections, about so many agree with the pose as well.
_FITTING_BY_CHANCE = 0.5


def _count_in_cells(
    pixels: F32 | F64, camera: Pinhole, config: RelocaliseConfig
) -> NDArray[np.int64]:
    cell = config.common_cell_px
    columns, rows = -(-camera.width // cell), -(-camera.height // cell)
    x = np.clip(pixels[:, 0] // cell, 0, columns - 1).astype(np.int64)
    y = np.clip(pixels[:, 1] // cell, 0, rows - 1).astype(np.int64)
    return np.bincount(y * columns + x, minlength=columns * rows)
