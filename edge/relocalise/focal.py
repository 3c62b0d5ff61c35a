# SPDX-License-Identifier: Apache-2.0
"""Whether the camera's focal length is that of what it sees.

A wrong one is not felt by any gate: poses move back or forth until most matches fit, all of
them by the same share, and so agree with one another and with the odometry, which uses it too.
"""

import numpy as np

from edge.geometry import so3
from edge.relocalise.assessment import Solution, distances
from edge.relocalise.correspondences import Correspondences, parts_of
from edge.types import F64, Pinhole

_HUBER_SIGMAS = 1.5
_SURE_SIGMAS = 3.0
_LEAST_INFORMATION = 1e-12


def focal_error(solution: Solution, matches: Correspondences, camera: Pinhole) -> float:
    """By what share the focal length is too short, surely; 0 where matches allow it to be right.

    It is solved for together with the pose, from the solution's inliers.
    """
    R, p = parts_of(solution.T_map_cam)
    use = solution.inlier
    _, variance = distances(matches, camera, R, p)
    xyz = (matches.xyz[use] - p) @ R
    ray = xyz[:, :2] / xyz[:, 2:]
    focal = np.array((camera.fx, camera.fy))
    off = matches.pixels[use] - ray * focal - (camera.cx, camera.cy)
    J = _jacobian(xyz, ray) * focal[:, None]
    sigma = np.sqrt(variance[use])[:, None]
    r, A = (off / sigma).ravel(), (J / sigma[..., None]).reshape(-1, 7)
    weight = 1.0 / np.maximum(1.0, np.abs(r) / _HUBER_SIGMAS)
    H = A.T @ (A * weight[:, None])
    try:
        H_inverse = np.linalg.inv(H)
    except np.linalg.LinAlgError:
        return 0.0
    step = H_inverse @ (A.T @ (weight * r))
    chi2 = float(weight @ (r - A @ step) ** 2) / max(len(r) - 7, 1)
    if not 0.0 < H_inverse[6, 6] < 1.0 / _LEAST_INFORMATION:
        return 0.0
    share = float(step[6])
    sure = abs(share) - _SURE_SIGMAS * float(np.sqrt(max(chi2, 1.0) * H_inverse[6, 6]))
    return float(np.copysign(max(sure, 0.0), share))


def _jacobian(xyz: F64, ray: F64) -> F64:
    """How rays (n, 2) change (n, 2, 7) with the points' shift, their turn, and ln f."""
    J = np.zeros((len(xyz), 2, 7))
    across = np.zeros((len(xyz), 2, 3))
    across[:, 0, 0] = across[:, 1, 1] = 1.0
    across[:, :, 2] = -ray
    across /= xyz[:, 2, None, None]
    J[:, :, :3] = across
    hats = np.stack([so3.hat(x) for x in xyz]) if len(xyz) else np.zeros((0, 3, 3))
    J[:, :, 3:6] = -across @ hats
    J[:, :, 6] = ray
    return J
