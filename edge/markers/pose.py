# SPDX-License-Identifier: Apache-2.0
"""A camera's pose from one square marker of known size; where two poses fit, none.

A small or distant square looks nearly the same from two sides: mirrored about the line of sight
(Schweighofer and Pinz 2006; Collins and Bartoli 2014). Both poses are found, both are refined, and
one is only believed where the other fits clearly worse.

The marker's frame: origin in its middle, x to the right, y up, z out of it towards who looks.
"""

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np

from edge.geometry import se3
from edge.types import F64, Mat4, Mat6, Pinhole

_STEPS = 12
_DONE_GAIN = 1e-6  # promised decrease of the cost, in squared sigmas
_COORDINATES = 8.0  # of a square's corners
# exp(-12.5) to one, in units of the variance that the better pose leaves.
_CLEAR_CHI2 = 25.0
_MAX_CHI2 = 20.0  # a freedom of the better one: beyond, what was found is no square


class MarkerPose(NamedTuple):
    """One of the poses from which a square is seen as it is."""

    T_cam_marker: Mat4
    covariance: Mat6  # of the twist on the left [m^2, rad^2]
    chi2: float  # of eight coordinates with six freedoms taken


def poses(corners: F64, side_m: float, camera: Pinhole, sigma_px: float) -> list[MarkerPose]:
    """Poses that may be, best first: one or two; none where the corners are no square's.

    corners : (4, 2) ideal px, from the upper left one, clockwise
    side_m : length of the black square's side
    sigma_px : standard deviation of a corner's coordinate
    """
    square = corner_points(side_m)
    K = np.array([[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]])
    count, turns, shifts, _ = cv2.solvePnPGeneric(
        square, np.asarray(corners, np.float64), K, None, flags=cv2.SOLVEPNP_IPPE_SQUARE
    )
    found = []
    for turn, shift in zip(turns[:count], shifts[:count], strict=True):
        R = cv2.Rodrigues(turn)[0]
        T = se3.from_rotation_translation(R, np.asarray(shift).ravel())
        # The marker has one printed side, so its front looks to the camera.
        if np.isfinite(T).all() and _is_seen(T, square):
            found.append(refined(T, square, corners, camera, sigma_px))
    found = [pose for pose in found if _is_seen(pose.T_cam_marker, square)]
    return sorted(found, key=lambda pose: pose.chi2)


def joint_poses(
    points: F64, corners: F64, starts: Sequence[Mat4], camera: Pinhole, sigma_px: float
) -> list[MarkerPose]:
    """Poses before several squares of known places, best first, from where each alone may be.

    points : (4 n, 3) corners in the frame of the squares
    corners : (4 n, 2) ideal px
    starts : T_cam_squares, those that single squares tell
    """
    found = [refined(T, points, corners, camera, sigma_px) for T in starts]
    ahead = [pose for pose in found if _is_ahead(pose.T_cam_marker, points)]
    return sorted(ahead, key=lambda pose: pose.chi2)


def believed(found: list[MarkerPose], squares: int = 1) -> MarkerPose | None:
    """The best pose if the other ones fit clearly worse, else None; see `poses`.

    For several images of one marker at rest, add up each side's `chi2` over them instead.
    """
    freedoms = _COORDINATES * squares - 6.0
    if not found or found[0].chi2 > _MAX_CHI2 * freedoms:
        return None
    best = found[0]
    # Corners that err by more than they should make both poses worse: their scatter is the unit.
    unit = max(1.0, best.chi2 / freedoms)
    others = [pose.chi2 for pose in found[1:] if not _same(pose.T_cam_marker, best.T_cam_marker)]
    if any(chi2 - best.chi2 < _CLEAR_CHI2 * unit for chi2 in others):
        return None
    return best._replace(covariance=best.covariance * unit)


def corner_points(side_m: float) -> F64:
    """Corners (4, 3) in the marker's frame, in the order of `poses`."""
    h = 0.5 * side_m
    return np.array([[-h, h, 0.0], [h, h, 0.0], [h, -h, 0.0], [-h, -h, 0.0]])


def refined(T: Mat4, points: F64, corners: F64, camera: Pinhole, sigma_px: float) -> MarkerPose:
    """Pose near T at the least squared distance of the corners (damped Gauss-Newton)."""
    e, J = _residuals(T, points, corners, camera, sigma_px)
    damping = 1e-4
    for _ in range(_STEPS):
        H, b = J.T @ J, J.T @ e
        step = np.linalg.solve(H + damping * np.diag(np.diag(H)), b)
        moved = se3.exp(step) @ T
        e_new, J_new = _residuals(moved, points, corners, camera, sigma_px)
        if not e_new @ e_new <= e @ e:
            damping *= 10.0
            continue
        T, e, J, damping = moved, e_new, J_new, 0.1 * damping
        if b @ step < _DONE_GAIN:
            break
    return MarkerPose(T, np.asarray(np.linalg.inv(J.T @ J), np.float64), float(e @ e))


def _residuals(
    T: Mat4, points: F64, corners: F64, camera: Pinhole, sigma_px: float
) -> tuple[F64, F64]:
    """Seen less projected (2 n,), and derivatives (2 n, 6) of the projection, in sigmas."""
    points = se3.transform(T, points)
    x, y, z = points.T
    focal = np.array([camera.fx, camera.fy]) / sigma_px
    flat = points[:, :2] / z[:, None]
    seen = (corners - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    J = np.zeros((len(points), 2, 6))
    by_point = np.zeros((len(points), 2, 3))
    by_point[:, 0, 0] = by_point[:, 1, 1] = 1.0 / z
    by_point[:, 0, 2], by_point[:, 1, 2] = -x / z**2, -y / z**2
    J[:, :, :3] = by_point
    J[:, :, 3:] = np.cross(points[:, None, :], by_point)
    return ((seen - flat) * focal).ravel(), (J * focal[:, None]).reshape(-1, 6)


def _is_seen(T: Mat4, square: F64) -> bool:
    """Whether all corners are before the camera, and it before the marker's front."""
    return _is_ahead(T, square) and bool(T[:3, 2] @ T[:3, 3] < 0.0)


def _is_ahead(T: Mat4, points: F64) -> bool:
    return bool(np.all(points @ T[2, :3] + T[2, 3] > 0.0))


def _same(A: Mat4, B: Mat4) -> bool:
    """Whether two poses differ by less than two degrees: then there is no second minimum."""
    cosine = 0.5 * (np.trace(A[:3, :3].T @ B[:3, :3]) - 1.0)
    return bool(cosine > np.cos(np.deg2rad(2.0)))
