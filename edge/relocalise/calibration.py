# SPDX-License-Identifier: Apache-2.0
"""Whether the camera's calibration is that of what it sees: its focal length, and how it bends.

A wrong one is not felt by any gate: poses move until most matches fit, all of them by the same
share, and so agree with one another and with the odometry, which uses it too. But what is left
over has a pattern, and it is the same in every image, while noise and errors of the map are not.
"""

import logging
from collections import deque
from typing import NamedTuple

import numpy as np

from edge.config.relocalise import RelocaliseConfig
from edge.geometry import so3
from edge.geometry.camera import CameraModel
from edge.relocalise.assessment import Solution, distances
from edge.relocalise.correspondences import Correspondences, parts_of
from edge.relocalise.lens import bent, lateness, turned_rows
from edge.types import F64, Mat4

log = logging.getLogger(__name__)

_HUBER_SIGMAS = 1.5
_SURE_SIGMAS = 3.0
_LIKELY_SIGMAS = 2.0
# What an image is solved for: how the points have moved and turned (the pose), how the camera
# turned [rad] and moved [depths] while rows were read, ln f, and the bend.
_POSE, _ROWS, _LENS = slice(0, 6), slice(6, 12), slice(12, 14)
_NUISANCE = slice(0, 12)
# Beforehand: a turn of 1 rad/s and a walk of a depth in 3 s, over 30 ms; a lens that may be any.
_ROW_TURN_RAD, _ROW_SHIFT_DEPTHS, _LENS_SHARE = 0.03, 0.01, 0.3
_PRIOR = np.repeat((0.0, _ROW_TURN_RAD**-2, _ROW_SHIFT_DEPTHS**-2, _LENS_SHARE**-2), (6, 3, 3, 2))
# Matches near one another err alike: so many count as one.
ALIKE = 2.0
# What all matches of one image may have in common besides: ln f and bend.
_COMMON = np.diag((0.004**2, 0.006**2))
# An image that tells less (sigmas) has nothing to say: of a wall alone, a map that is a centimetre
# off tells any focal length, and so do all images of that wall.
_MOST_SIGMA = np.array((0.03, 0.03))
# Images from nearly one place and direction are one witness.
_NEAR_DEPTH_SHARE, _NEAR_RAD = 0.01, 0.02


class LensEvidence(NamedTuple):
    """What one image tells of the lens: ln(true focal length / ours), and the bend.

    The bend is by how much farther out the image's corner lies, as a share of half its diagonal.
    """

    information: F64  # (2, 2)
    vector: F64  # (2,) the information times the most likely values
    pose_shift: F64  # (6, 2) of the pose, by each; position and rotation, map axes


class LensError(NamedTuple):
    """By how much a lens differs from its calibration, and the sigmas of both."""

    share: F64  # (2,) of the focal length; of the image's corner
    sigma: F64  # (2,)

    @property
    def sure(self) -> F64:
        """The part (2,) of both that is beyond doubt."""
        least = np.maximum(np.abs(self.share) - _SURE_SIGMAS * self.sigma, 0.0)
        return np.asarray(np.copysign(least, self.share))

    @property
    def text(self) -> str:
        """For a person."""
        focal, corner = self.share
        return (
            f"focal_length={abs(focal):.1%}_too_{'short' if focal > 0.0 else 'long'} "
            f"corners={abs(corner):.1%}_too_far_{'in' if corner > 0.0 else 'out'}"
        )


def evidence(
    solution: Solution, matches: Correspondences, camera: CameraModel
) -> LensEvidence | None:
    """What the inliers of a solution tell of the lens, whatever the pose; None if too little."""
    A, r, weight, R = left_over(solution, matches, camera)
    H, g = A.T @ (A * weight[:, None]) + np.diag(_PRIOR), A.T @ (weight * r)
    try:
        chi2 = float(weight @ (r - A @ np.linalg.solve(H, g)) ** 2) / max(len(r) - len(g), 1)
        by_lens = np.linalg.solve(H[_NUISANCE, _NUISANCE], H[_NUISANCE, _LENS])
        left = H[_LENS, _LENS] - H[_LENS, _NUISANCE] @ by_lens - np.diag(_PRIOR[_LENS])
        told = g[_LENS] - by_lens.T @ g[_NUISANCE]
        # Errors that all matches share make even a thousand of them no more exact than this.
        each = ALIKE * max(chi2, 1.0)
        limit = np.linalg.inv(np.eye(2) + left @ _COMMON / each) / each
        shift = np.vstack((R @ by_lens[:3], R @ by_lens[3:6]))
    except np.linalg.LinAlgError:
        return None
    found = LensEvidence(limit @ left, limit @ told, shift)
    if not all(np.all(np.isfinite(part)) for part in found):
        return None
    return found if np.all(error_of([found]).sigma < _MOST_SIGMA) else None


def left_over(
    solution: Solution, matches: Correspondences, camera: CameraModel
) -> tuple[F64, F64, F64, F64]:
    """How n inliers change (2 n, 14), what is left of them (2 n,), its weights; R_map_cam.

    In sigmas; columns are points' move and turn, the rows' turn and move, ln f, and the bend.
    """
    R, p = parts_of(solution.T_map_cam)
    use = solution.inlier
    _, variance = distances(matches, camera.pinhole, R, p)
    xyz = (matches.xyz[use] - p) @ R
    ray = xyz[:, :2] / xyz[:, 2:]
    focal = np.array((camera.fx, camera.fy))
    off = matches.pixels[use] - ray * focal - (camera.cx, camera.cy)
    sigma = np.sqrt(variance[use])[:, None]
    J = _jacobian(xyz, ray, solution.depth_m, camera) * (focal / sigma)[..., None]
    r, A = (off / sigma).ravel(), J.reshape(-1, J.shape[2])
    return A, r, 1.0 / np.maximum(1.0, np.abs(r) / _HUBER_SIGMAS), R


def error_of(told: list[LensEvidence]) -> LensError:
    """What several images tell together."""
    information = np.sum([one.information for one in told], axis=0) + np.diag(_PRIOR[_LENS])
    covariance = np.linalg.inv(0.5 * (information + information.T))
    share = covariance @ np.sum([one.vector for one in told], axis=0)
    return LensError(share, np.sqrt(np.diag(covariance)))


def is_wrong(error: LensError, config: RelocaliseConfig) -> bool:
    """Whether a lens is not as it was calibrated: surely by much, or likely by twice as much."""
    limits = np.array((config.max_focal_error, config.max_corner_error))
    sure = np.abs(error.sure)
    much = (sure > limits) | ((sure > 0.0) & (np.abs(error.share) > 2.0 * limits))
    return bool(np.any(much))


class LensWatch:
    """Gathers what the last images tell of the lens. Owned by the relocaliser's thread."""

    def __init__(self, config: RelocaliseConfig) -> None:
        self._config = config
        self._told: deque[tuple[Mat4, float, LensEvidence]] = deque(maxlen=config.lens_images)
        self._warned = self._was_wrong = False

    def add(self, solution: Solution, told: LensEvidence) -> None:
        """Take in an image; one of several from the same place is kept."""
        if self._told and _near(self._told[-1][0], solution.T_map_cam, self._told[-1][1]):
            self._told.pop()
        self._told.append((solution.T_map_cam, solution.depth_m, told))

    @property
    def is_wrong(self) -> bool:
        """Whether the images together speak surely against the calibration; warns of it once."""
        if not self._told:
            return False
        error = error_of([told for _, _, told in self._told])
        # Once found wrong, it has to look right again: doubt alone does not acquit it.
        limits = (self._config.max_focal_error, self._config.max_corner_error)
        suspect = self._was_wrong and bool(np.any(np.abs(error.share) > limits))
        self._was_wrong = suspect or is_wrong(error, self._config)
        if not self._was_wrong:
            return False
        if not self._warned:
            self._warned = True
            log.warning("event=calibration_off %s remedy=calibrate the camera", error.text)
        return True

    def doubt(self, told: LensEvidence) -> F64:
        """Covariance (6, 6) that an image's pose has by what its lens is likely to be off by.

        What cannot be told from a right lens does not count: how well lenses are known in general
        is in the pose's own covariance.
        """
        error = error_of([one for _, _, one in self._told] or [told])
        likely = np.abs(error.share) > _LIKELY_SIGMAS * error.sigma
        shift = told.pose_shift @ np.where(likely, error.share, 0.0)
        return np.outer(shift, shift)


def _near(T_a: Mat4, T_b: Mat4, depth_m: float) -> bool:
    moved = float(np.linalg.norm(T_a[:3, 3] - T_b[:3, 3]))
    return (
        moved < _NEAR_DEPTH_SHARE * depth_m and so3.angle(T_a[:3, :3].T @ T_b[:3, :3]) < _NEAR_RAD
    )


def _jacobian(xyz: F64, ray: F64, depth_m: float, camera: CameraModel) -> F64:
    """How rays (n, 2) change (n, 2, 14) with all that an image is solved for."""
    J = np.zeros((len(xyz), 2, _LENS.stop))
    across = np.zeros((len(xyz), 2, 3))
    across[:, 0, 0] = across[:, 1, 1] = 1.0
    across[:, :, 2] = -ray
    across /= xyz[:, 2, None, None]
    J[:, :, :3] = across
    x, y, z = xyz.T
    J[:, :, 3] = across[:, :, 2] * y[:, None] - across[:, :, 1] * z[:, None]
    J[:, :, 4] = across[:, :, 0] * z[:, None] - across[:, :, 2] * x[:, None]
    J[:, :, 5] = across[:, :, 1] * x[:, None] - across[:, :, 0] * y[:, None]
    raw = camera.denormalise(camera.distort(ray))
    late = lateness(raw, camera)
    for axis, turn in enumerate(np.eye(3)):
        J[:, :, _ROWS.start + axis] = late[:, None] * turned_rows(ray, turn)
    J[:, :, _ROWS.start + 3 : _ROWS.stop] = late[:, None, None] * depth_m * across
    J[:, :, _LENS.start] = ray
    J[:, :, _LENS.start + 1] = bent(camera, ray, 1.0)
    return J
