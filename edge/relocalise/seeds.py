# SPDX-License-Identifier: Apache-2.0
"""Depths of an image that was found in the map, for an odometry to start from."""

import numpy as np

from edge.relocalise.assessment import Solution
from edge.relocalise.match import Matches
from edge.relocalise.pool import Pool, unpacked
from edge.types import DepthSamples, Pinhole


def depths(pool: Pool, found: Matches, solution: Solution, camera: Pinhole) -> DepthSamples:
    """Inverse depths [1 / map unit] of the points that fit, where they appear in the image.

    Their sigmas are those of the points; the error of the pose is common to all.
    """
    point = pool.point[found.row[solution.inlier]]
    T = solution.T_map_cam
    axis = T[:3, 2]
    x, y, z = ((pool.xyz[point] - T[:3, 3]) @ T[:3, :3]).T
    sigma = np.sqrt(np.einsum("i,nij,j->n", axis, unpacked(pool.C[point]), axis))
    pixels = np.column_stack((camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy))
    samples = DepthSamples(
        pixels.astype(np.float32), (1.0 / z).astype(np.float32), (sigma / z**2).astype(np.float32)
    )
    for array in (samples.pixels, samples.inverse_depth, samples.sigma):
        array.flags.writeable = False
    return samples
