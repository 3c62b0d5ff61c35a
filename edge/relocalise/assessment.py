# SPDX-License-Identifier: Apache-2.0
"""What a pose is worth: covariance, evidence and spread of the matches that it explains."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edge.config.relocalise import RelocaliseConfig
from edge.relocalise import kernels_covariance, kernels_likelihood, kernels_pose
from edge.relocalise.correspondences import NO_KERNEL, Correspondences, parts_of
from edge.types import F64, Mat4, Mat6, Pinhole

Bools = NDArray[np.bool_]
# Mean squared Mahalanobis distance of right matches below the gate of 99 %, per dimension.
_KEPT_BY_GATE = 0.953


class Solution(NamedTuple):
    """A pose and what speaks for it."""

    T_map_cam: Mat4
    covariance: Mat6  # position, rotation; map axes
    inlier: Bools  # (n,)
    gain: float  # log likelihood ratio against chance
    chi2: float  # reduced, of the inliers
    cells: int  # image cells that hold inliers
    spread: float  # of the inliers along their narrow axis, as a share of the image's height
    depth_m: float  # harmonic mean depth of the inliers


def assessed(
    T_map_cam: Mat4,
    matches: Correspondences,
    by_parts: Mat6 | None,
    camera: Pinhole,
    config: RelocaliseConfig,
) -> Solution | None:
    """Solution at a pose; `by_parts` is its covariance by the disagreement of parts, if known."""
    R, p = parts_of(T_map_cam)
    m2, _ = distances(matches, camera, R, p)
    inlier = m2 < config.gate_chi2
    if np.count_nonzero(inlier) < 6:
        return None
    use = inlier.astype(np.float64)
    n = int(np.count_nonzero(inlier))
    H, b = np.empty((6, 6)), np.empty(6)
    S, S_depth, S_lens = np.empty((3, 6, 6))
    kernels_pose.normal_equations(*matches[:4], use, camera, R, p, NO_KERNEL, NO_KERNEL, H, b)
    cell = config.common_cell_px
    columns, rows = -(-camera.width // cell), -(-camera.height // cell)
    M = np.empty((columns * rows, 3))
    cells = kernels_covariance.common_scatter(
        *matches[:4],
        use,
        camera,
        R,
        p,
        cell,
        columns,
        rows,
        matches.axis,
        config.common_area_cells,
        matches.lens,
        S,
        S_depth,
        S_lens,
        M,
    )
    try:
        inverse = np.linalg.inv(H)
    except np.linalg.LinAlgError:
        return None
    chi2 = float(m2[inlier].sum()) / (max(2 * n - 6, 1) * _KEPT_BY_GATE)
    common_px2 = _common_variance(M, chi2, config)
    shared = common_px2 * S + config.common_depth_sigmas**2 * S_depth + S_lens
    covariance = max(chi2, config.least_chi2) * inverse + inverse @ shared @ inverse
    depth = (matches.xyz[inlier] - p) @ R[:, 2]
    depth_m = 1.0 / float(np.mean(1.0 / depth))
    # Where matches of one cell err little together, so does the whole image.
    floor = min(config.floor_share, config.floor_commons * math.sqrt(common_px2) / camera.fx)
    covariance += np.diag(np.repeat(((floor * depth_m) ** 2, floor**2), 3))
    if by_parts is not None:
        covariance += by_parts
    narrow = kernels_covariance.spread(matches.pixels, use) / camera.height
    gain = gain_of(matches, T_map_cam, camera, config)
    covariance = 0.5 * (covariance + covariance.T)
    return Solution(T_map_cam, covariance, inlier, gain, chi2, int(cells), float(narrow), depth_m)


def _common_variance(M: F64, chi2: float, config: RelocaliseConfig) -> float:
    """Variance [px^2] of the errors that a cell's matches share, by how far their means scatter.

    Few cells say little: the configured value counts as much as so many of them.
    """
    used = np.isfinite(M[:, 2])
    independent = max(chi2, config.least_chi2) * M[used, 2]
    excess = 0.5 * (M[used, 0] ** 2 + M[used, 1] ** 2) - independent
    # A mean that is itself uncertain says less about the excess.
    weight = (config.common_px**2 / (config.common_px**2 + independent)) ** 2
    total = config.common_px**2 * config.common_prior_cells + float(weight @ excess)
    mean = total / (config.common_prior_cells + float(weight.sum()))
    return max(mean, (0.3 * config.common_px) ** 2)


def gain_of(
    matches: Correspondences, T_map_cam: Mat4, camera: Pinhole, config: RelocaliseConfig
) -> float:
    """How much better a pose explains the matches than chance: a log likelihood ratio."""
    R, p = parts_of(T_map_cam)
    return float(
        kernels_likelihood.likelihood_gain(
            *matches[:4], camera, R, p, clutter_px2(camera), config.gate_chi2
        )
    )


def distances(matches: Correspondences, camera: Pinhole, R: F64, p: F64) -> tuple[F64, F64]:
    """Squared Mahalanobis distance (n,) of each match, and its mean variance (n,) [px^2]."""
    m2, variance = np.empty((2, len(matches.pixels)))
    kernels_pose.mahalanobis(*matches[:4], camera, R, p, m2, variance)
    return m2, variance


def clutter_px2(camera: Pinhole) -> float:
    """Area over which wrong matches are spread."""
    return float(camera.width * camera.height)
