# SPDX-License-Identifier: Apache-2.0
"""How a pose would differ without each part of the image: the jackknife of Quenouille and Tukey.

Covariances of matches know noise, not that some of them are wrong together: a chair that was
mapped wrongly, a poster that hangs twice. What one part of the image says against all the others
shows in how far the pose moves without it. And what the matches beyond the gate say shows in how
far it moves where they count a little.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edge.config.relocalise import RelocaliseConfig
from edge.geometry.se3 import from_rotation_translation
from edge.relocalise import kernels_pose
from edge.relocalise.correspondences import NO_KERNEL, Correspondences, parts_of, pose_difference
from edge.types import F64, Mat4, Mat6, Pinhole

_COLUMNS, _ROWS = 4, 3
_STEPS = 8
_WIDE_CHI2 = 60.0  # squared Cauchy scale that lets a pose leave a wrong place
# Share of what is known about some direction beyond which a part is left out in earnest; the
# others move the pose by a linear step.
_LEVERAGE = 0.3
_LEFT = 12  # matches that must stay for a pose without a part


class Stability(NamedTuple):
    """What leaving out parts of the image tells."""

    covariance: Mat6  # of the pose by the disagreement of parts, and of what lies beyond the gate
    others: list[Mat4]  # poses that were searched without one part


def stability(
    T_map_cam: Mat4,
    matches: Correspondences,
    inlier: F64,
    camera: Pinhole,
    config: RelocaliseConfig,
) -> Stability:
    """Spread of the poses that each lack one part; `inlier` (n,) is 1 for a match in use."""
    part = _parts(matches.pixels, camera)
    numbers = np.unique(part[inlier > 0.0])
    systems = [_system(T_map_cam, matches, inlier * (part == g), camera, config) for g in numbers]
    H = np.sum([system[0] for system in systems], axis=0)
    try:
        root = np.linalg.inv(np.linalg.cholesky(H))
    except np.linalg.LinAlgError:
        return Stability(np.zeros((6, 6)), [])
    if not np.all(np.isfinite(root)):
        return Stability(np.zeros((6, 6)), [])
    steps, others = [], []
    for number, (H_part, b_part) in zip(numbers, systems, strict=True):
        left = part != number
        enough = np.count_nonzero(inlier[left]) >= _LEFT
        share = root @ H_part @ root.T  # of what is known about each direction
        leverage = float(np.linalg.eigvalsh(share)[-1])
        if leverage > _LEVERAGE and enough:
            others.append(_without(T_map_cam, matches, left, camera, config))
            steps.append(pose_difference(others[-1], T_map_cam))
        else:
            # In these directions it can be solved however badly conditioned H is.
            left_over = np.eye(6) - min(1.0, 0.9 / max(leverage, 1e-9)) * share
            steps.append(-root.T @ np.linalg.solve(left_over, root @ b_part))
    n = len(steps)
    d = np.array(steps) - np.mean(steps, axis=0)
    soft = pose_difference(_soft(T_map_cam, matches, camera), T_map_cam)
    return Stability((n - 1.0) / n * d.T @ d + np.outer(soft, soft), others)


def _parts(pixels: F64, camera: Pinhole) -> NDArray[np.int64]:
    u = np.clip(pixels[:, 0] * _COLUMNS // camera.width, 0, _COLUMNS - 1)
    v = np.clip(pixels[:, 1] * _ROWS // camera.height, 0, _ROWS - 1)
    return (v * _COLUMNS + u).astype(np.int64)


def _system(
    T_map_cam: Mat4, matches: Correspondences, use: F64, camera: Pinhole, config: RelocaliseConfig
) -> tuple[F64, F64]:
    H, b = np.empty((6, 6)), np.empty(6)
    kernels_pose.normal_equations(
        *matches[:4], use, camera, *parts_of(T_map_cam), NO_KERNEL, config.gate_chi2, H, b
    )
    return H, b


def _without(
    T_map_cam: Mat4,
    matches: Correspondences,
    left: NDArray[np.bool_],
    camera: Pinhole,
    config: RelocaliseConfig,
) -> Mat4:
    R, p = parts_of(T_map_cam)
    H, use = np.empty((6, 6)), left.astype(np.float64)
    gate = config.gate_chi2
    kernels_pose.refine(*matches[:4], use, camera, R, p, _WIDE_CHI2, NO_KERNEL, _STEPS, H)
    kernels_pose.refine(*matches[:4], use, camera, R, p, NO_KERNEL, gate, _STEPS, H)
    return from_rotation_translation(R, p)


def _soft(T_map_cam: Mat4, matches: Correspondences, camera: Pinhole) -> Mat4:
    """The pose by a kernel that lets every match count."""
    R, p = parts_of(T_map_cam)
    H, use = np.empty((6, 6)), np.ones(len(matches.pixels))
    kernels_pose.refine(*matches[:4], use, camera, R, p, _WIDE_CHI2, NO_KERNEL, _STEPS, H)
    return from_rotation_translation(R, p)
