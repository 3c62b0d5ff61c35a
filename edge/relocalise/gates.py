# SPDX-License-Identifier: Apache-2.0
"""Whether a pose is believed: by its covariance and by what is seen, not by a count."""

import numpy as np
from numpy.typing import NDArray

from edge.config.relocalise import RelocaliseConfig
from edge.relocalise.absolute_pose import Solution, position_sigma_m, rotation_sigma_deg
from edge.relocalise.pool import Pool
from edge.relocalise.projection import Projection
from edge.types import F32, F64, Pinhole


def why_not(solution: Solution, share: float, config: RelocaliseConfig) -> str:
    """Return 'ok', or the first reason against the solution; `share` is that of `seen_share`."""
    if np.count_nonzero(solution.inlier) < config.min_inliers:
        return "few inliers"
    if solution.cells < config.min_cells or solution.spread < config.min_spread:
        return "inliers in a corner of the image"
    if position_sigma_m(solution.covariance) > config.max_sigma_depth_share * solution.depth_m:
        return "position uncertain"
    if rotation_sigma_deg(solution.covariance) > config.max_sigma_deg:
        return "rotation uncertain"
    if share < config.min_seen_share:
        return "little of what should be seen is seen"
    return "ok"


def seen_share(
    pool: Pool, projection: Projection, inliers: F32, camera: Pinhole, config: RelocaliseConfig
) -> float:
    """Share of the image's cells that show something where the map says that much is to be seen.

    A wrong pose may have its inliers on one poster, but not all over what it should see.

    inliers  (n, 2)  float32  pixels of the features that fit
    """
    expected = projection.centre[np.unique(pool.point[projection.radius_px > 0.0])]
    much = _count_in_cells(expected, camera, config) >= config.expected_in_cell
    seen = _count_in_cells(inliers, camera, config) > 0
    return int(np.count_nonzero(much & seen)) / max(int(np.count_nonzero(much)), 1)


def _count_in_cells(
    pixels: F32 | F64, camera: Pinhole, config: RelocaliseConfig
) -> NDArray[np.int64]:
    cell = config.common_cell_px
    columns, rows = -(-camera.width // cell), -(-camera.height // cell)
    x = np.clip(pixels[:, 0] // cell, 0, columns - 1).astype(np.int64)
    y = np.clip(pixels[:, 1] // cell, 0, rows - 1).astype(np.int64)
    return np.bincount(y * columns + x, minlength=columns * rows)
