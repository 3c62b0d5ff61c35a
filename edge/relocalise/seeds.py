# SPDX-License-Identifier: Apache-2.0
"""Depths of an image that was found in the map, for an odometry to start from."""

import numpy as np

from edge.lines.line import Lines, Segments, across
from edge.relocalise.assessment import Solution
from edge.relocalise.match import Matches
from edge.relocalise.pool import Pool, unpacked
from edge.types import F64, DepthSamples, Mat4, Pinhole

_APART_PX = 4.0  # places along a segment: the odometry's points keep two of its own pixels apart


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
    return _samples(pixels, z, sigma)


def along_lines(
    lines: Lines, span: F64, segments: Segments, T_map_cam: Mat4, camera: Pinhole
) -> DepthSamples:
    """Inverse depths [1 / map unit] at places along segments (n), each the image of a line (n).

    span : (n, 2) part of each line that is known to exist, from its point
    The sigmas are those of the lines. A place that looks along its line is accordingly uncertain.
    """
    count = np.maximum(segments.length // _APART_PX, 1.0).astype(np.int64)
    row = np.repeat(np.arange(len(count)), count)
    step = np.arange(len(row)) - np.repeat(np.cumsum(count) - count, count)
    off = (step - 0.5 * (count[row] - 1)) * _APART_PX
    pixels = segments.middle[row] + off[:, None] * segments.direction[row]
    u, v = pixels.T
    rays = np.column_stack((u - camera.cx, v - camera.cy, np.ones(len(u))))
    rays[:, :2] /= [camera.fx, camera.fy]
    rays = rays @ T_map_cam[:3, :3].T
    point, direction = lines.point[row] - T_map_cam[:3, 3], lines.direction[row]
    # Where the ray comes nearest to the line, and how a shift of the line moves that.
    cosine = np.sum(rays * direction, axis=1)
    apart = np.maximum(np.sum(rays * rays, axis=1) - cosine**2, 1e-9)
    by_shift = (rays - cosine[:, None] * direction) / apart[:, None]
    depth = np.sum(by_shift * point, axis=1)
    at = cosine * depth - np.sum(point * direction, axis=1)
    shift = np.einsum("nki,ni->nk", across(direction), by_shift)
    jacobian = np.hstack((shift, at[:, None] * shift))
    sigma = np.sqrt(np.einsum("ni,nij,nj->n", jacobian, lines.covariance[row], jacobian))
    seen = (depth > 0.0) & (at >= span[row, 0]) & (at <= span[row, 1])
    return _samples(pixels[seen], depth[seen], sigma[seen])


def joined(first: DepthSamples | None, second: DepthSamples) -> DepthSamples:
    """Both one after the other."""
    if first is None:
        return second
    return _frozen(
        DepthSamples(
            np.vstack((first.pixels, second.pixels)),
            np.concatenate((first.inverse_depth, second.inverse_depth)),
            np.concatenate((first.sigma, second.sigma)),
        )
    )


def _samples(pixels: F64, depth: F64, sigma: F64) -> DepthSamples:
    inverse, spread = (1.0 / depth).astype(np.float32), (sigma / depth**2).astype(np.float32)
    return _frozen(DepthSamples(pixels.astype(np.float32), inverse, spread))


def _frozen(samples: DepthSamples) -> DepthSamples:
    for array in (samples.pixels, samples.inverse_depth, samples.sigma):
        array.flags.writeable = False
    return samples
