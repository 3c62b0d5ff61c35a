# SPDX-License-Identifier: Apache-2.0
"""Whether a pose is believed: by its covariance and by what is seen, not by a count."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edge.config.relocalise import RelocaliseConfig
from edge.geometry.covariance import position_sigma, rotation_sigma
from edge.relocalise.assessment import Solution
from edge.types import F32, F64, U8, Pinhole

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


class Fitting(NamedTuple):
    """What was found near projections."""

    pixels: F32  # (m, 2) of the features
    fits: Bools  # (m,) those that agree with the pose
    chance: float  # matches per point where the projections are shifted to where they do not belong
    visible: float  # share of the points for which the image has features, from `visible_share`


_MAX_OCTAVE = 30
_LEAST_VISIBLE = 0.1  # an image of next to no features proves nothing
LITTLE_SEEN = "little of what should be seen is seen"
AMBIGUOUS = "ambiguous"
WRONG_LENS = "the calibration does not fit the map"
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
        return LITTLE_SEEN
    return "ok"


def seen_from(expected: F64, found: Fitting, camera: Pinhole, config: RelocaliseConfig) -> Seen:
    """Compare what should be seen with what is.

    expected  (n, 2)  float64  projections of the points that should appear
    """
    n_expected = _count_in_cells(expected, camera, config)
    n_seen = _count_in_cells(found.pixels[found.fits], camera, config)
    much = n_expected >= config.expected_in_cell
    by_chance = _FITTING_BY_CHANCE * found.chance * n_expected
    beyond = n_seen > np.maximum(1.0, by_chance + 2.0 * np.sqrt(by_chance))
    fitting = float(found.fits.sum())
    return Seen(
        min(fitting / max(found.visible * len(expected), 1.0), 1.0),
        float((much & beyond).sum()) / max(float(much.sum()), 1.0),
        fitting / max(len(found.pixels), 1),
    )


def visible_share(level: F32, octave: U8) -> float:
    """Of the points that should appear, the share for which the image has features at all.

    A dark or blurred image has few at fine octaves: that they are missing there says nothing
    against a pose. Points (n,) should appear at octaves `level`; a feature (m,) of a neighbouring
    `octave` might be any of them.
    """
    expected = np.bincount(np.clip(np.rint(level), 0, _MAX_OCTAVE).astype(np.int64))
    there = np.bincount(octave.astype(np.int64), minlength=len(expected) + 1)[: len(expected) + 1]
    near = np.convolve(there, (1, 1, 1))[1 : 1 + len(expected)]
    share = float(np.minimum(expected, near).sum()) / max(len(level), 1)
    return max(share, _LEAST_VISIBLE)


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
