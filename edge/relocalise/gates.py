# SPDX-License-Identifier: Apache-2.0
"""Whether a pose is believed: by its covariance and by what is seen, not by a count."""

import numpy as np

from edge.config.relocalise import RelocaliseConfig
from edge.relocalise.absolute_pose import Solution, position_sigma_m, rotation_sigma_deg


def why_not(solution: Solution, seen_share: float, config: RelocaliseConfig) -> str:
    """Return 'ok', or the first reason against the solution."""
    if np.count_nonzero(solution.inlier) < config.min_inliers:
        return "few inliers"
    if solution.cells < config.min_cells or solution.spread < config.min_spread:
        return "inliers in a corner of the image"
    if position_sigma_m(solution.covariance) > config.max_sigma_depth_share * solution.depth_m:
        return "position uncertain"
    if rotation_sigma_deg(solution.covariance) > config.max_sigma_deg:
        return "rotation uncertain"
    if seen_share < config.min_seen_share:
        return "little of what should be seen is seen"
    return "ok"
