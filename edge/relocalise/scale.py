# SPDX-License-Identifier: Apache-2.0
"""How long an odometry unit is in the map, from depths that both have at the same pixels."""

import math

import numpy as np
from numpy.typing import NDArray

from edge.config.relocalise import RelocaliseConfig
from edge.relocalise.kernels_neighbours import nearest_samples
from edge.relocalise.pool import Pool, unpacked
from edge.types import F32, F64, DepthSamples, Mat4, Pinhole

_ROUNDS = 10
_SIGMA_PER_MAD = 1.4826
_CAUCHY = 2.0  # robust scale [sigmas]


def log_scale(
    pool: Pool, T_map_cam: Mat4, camera: Pinhole, samples: DepthSamples, config: RelocaliseConfig
) -> tuple[float, float] | None:
    """ln(map units per odometry unit) and its sigma, given the pose of the samples' frame.

    Every point of the pool that falls near a sample is compared with it. Points that are hidden
    from here disagree with one another; those in view agree.
    """
    p, axis = T_map_cam[:3, 3], T_map_cam[:3, 2]
    ray = pool.xyz - p
    x, y, depth = (ray @ T_map_cam[:3, :3]).T
    sigma = np.sqrt(np.einsum("i,nij,j->n", axis, unpacked(pool.C), axis))
    usable = (depth > 0.0) & (sigma < config.scale_max_depth_sigma * depth)
    x, y, depth, sigma = x[usable], y[usable], depth[usable], sigma[usable]
    u, v = camera.fx * x / depth + camera.cx, camera.fy * y / depth + camera.cy
    pair = _neighbours(np.stack((u, v), axis=1), samples.pixels, config.scale_px)
    good = pair >= 0
    inverse = samples.inverse_depth[pair[good]].astype(np.float64)
    relative = samples.sigma[pair[good]] / np.maximum(inverse, 1e-9)
    good[good] = (inverse > 0.0) & (relative < config.scale_max_depth_sigma)
    if np.count_nonzero(good) < config.scale_min_points:
        return None
    inverse = samples.inverse_depth[pair[good]].astype(np.float64)
    relative = samples.sigma[pair[good]] / inverse
    ratio = np.log(depth[good] * inverse)
    variance = (sigma[good] / depth[good]) ** 2 + relative**2 + config.scale_point_sigma**2
    average = _mean_ratio if config.scale_mean_ratio else _robust_mean
    mean = average(ratio, np.sqrt(variance), config)
    if mean is None:
        return None
    # Depths of one window are wrong together, the more so the less certain they are.
    common = math.hypot(
        config.scale_common, config.scale_common_sigmas * float(np.median(relative))
    )
    return mean[0], math.hypot(mean[1], common)


def _robust_mean(ratio: F64, sigma: F64, config: RelocaliseConfig) -> tuple[float, float] | None:
    """Mean and its sigma, from the median on, by a Cauchy kernel as wide as the MAD."""
    centre = float(np.median(ratio))
    unit = ratio - centre
    width = _SIGMA_PER_MAD * float(np.median(np.abs(unit) / sigma))
    width = max(width, 1.0)
    weight = 1.0 / sigma**2
    for _ in range(_ROUNDS):
        off = (ratio - centre) / (_CAUCHY * width * sigma)
        weight = 1.0 / (sigma**2 * (1.0 + off * off))
        centre = float(np.sum(weight * ratio) / np.sum(weight))
    near = np.abs(ratio - centre) < 3.0 * width * sigma
    if np.count_nonzero(near) < max(config.scale_min_points, 0.3 * len(ratio)):
        return None
    variance = width**2 / float(np.sum(1.0 / sigma[near] ** 2))
    return centre, math.sqrt(variance)


def _mean_ratio(ratio: F64, sigma: F64, config: RelocaliseConfig) -> tuple[float, float] | None:
    """Logarithm of the plain mean of the ratios, hidden points and all; and its sigma."""
    unit = np.exp(ratio)
    mean = float(np.mean(unit))
    return math.log(mean), float(np.std(unit)) / mean / math.sqrt(len(unit))


def _neighbours(pixels: F64, samples: F32, radius_px: float) -> NDArray[np.int64]:
    """Nearest sample (n,) to each pixel within `radius_px`, or -1."""
    nearest = np.full(len(pixels), -1, np.int64)
    order = np.argsort(samples[:, 1], kind="stable")
    rows = samples[order, 1].astype(np.float64)
    nearest_samples(pixels, samples, order, rows, radius_px, nearest)
    return nearest
