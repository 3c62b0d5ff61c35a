# SPDX-License-Identifier: Apache-2.0
"""Intrinsics and lens of a camera from views of known points: bundle adjustment with fixed points.

Each view has a pose of its own, which is eliminated (Schur complement), so that the work grows
with the number of views only linearly.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from edge.errors import ConfigError
from edge.geometry import distortion, se3
from edge.geometry.camera import CameraModel
from edge.types import F64, Mat4

_PINHOLE = 4  # fx fy cx cy, before the lens's coefficients
_HUBER_PX = 1.0
_MAX_STEPS = 60
_CONVERGED = 1e-7  # relative fall of the cost
_EXACT_PX = 1e-7  # below, there is nothing more to gain
_UNTOLD = 1e-13  # of scaled information: rounding leaves so much where there is none
_LAMBDA_FIRST, _LAMBDA_MOST = 1e-3, 1e8


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """Points that are seen in one image."""

    points: F64  # (n, 3) in the board's frame [m]
    pixels: F64  # (n, 2) raw


class Calibrated(NamedTuple):
    """The camera that explains the views best."""

    camera: CameraModel
    T_cam_board: tuple[Mat4, ...]  # of each view
    rms_px: float  # per coordinate
    sigma: F64  # (4 + k,) of fx fy cx cy and the coefficients
    residuals: tuple[F64, ...]  # (n, 2) of each view, measured minus projected [px]


class _System(NamedTuple):
    """Normal equations, the camera's block and each view's."""

    cost: float
    H: F64  # (m, m)
    b: F64  # (m,)
    views: list[tuple[F64, F64, F64]]  # H_vv (6, 6), H_iv (m, 6), b_v (6,)


def calibrate(camera: CameraModel, views: Sequence[View], poses: Sequence[Mat4]) -> Calibrated:
    """Refine a camera and poses (4, 4) that are roughly right."""
    T = list(poses)
    damping = _LAMBDA_FIRST
    system = _linearise(camera, views, T)
    least = _EXACT_PX**2 * sum(view.pixels.size for view in views)
    for _ in range(_MAX_STEPS):
        trial = _step(camera, T, system, damping)
        after = None if trial is None else _linearise(trial[0], views, trial[1])
        if trial is None or after is None or not after.cost < system.cost:
            damping *= 8.0
            if damping > _LAMBDA_MOST:
                break
            continue
        has_converged = system.cost - after.cost < _CONVERGED * system.cost or after.cost < least
        (camera, T), system, damping = trial, after, max(damping / 8.0, 1e-12)
        if has_converged:
            break
    return _result(camera, views, T)


def refine_pose(camera: CameraModel, view: View, T_cam_board: Mat4) -> Mat4:
    """Pose (4, 4) of one view by a camera that is held fixed."""
    T = T_cam_board
    for _ in range(20):
        residual, _, J = _residual_and_jacobians(camera, view.pixels, _move(T, view.points))
        w = _weights(residual)[:, None]
        J = J.reshape(-1, 6)
        H, b = J.T @ (J * w), J.T @ (residual.reshape(-1) * w[:, 0])
        xi = np.linalg.solve(H + 1e-12 * np.eye(6) * np.trace(H), b)
        T = se3.exp(xi) @ T
        if np.abs(xi).max() < 1e-10:
            break
    return T


def residual_px(camera: CameraModel, view: View, T_cam_board: Mat4) -> F64:
    """Measured minus projected pixels (n, 2); nan where the lens sees no such point."""
    return view.pixels - camera.project(_move(T_cam_board, view.points))


def _result(camera: CameraModel, views: Sequence[View], T: list[Mat4]) -> Calibrated:
    residuals = tuple(residual_px(camera, view, pose) for view, pose in zip(views, T, strict=True))
    squares = float(sum(np.nansum(residual**2) for residual in residuals))
    count = sum(residual.size for residual in residuals)
    free = max(count - 6 * len(views) - _PINHOLE - len(camera.distortion), 1)
    S, _, _ = _eliminate(_linearise(camera, views, T), 0.0)
    sigma = np.sqrt(_variances(S) * squares / free)
    return Calibrated(camera, tuple(T), float(np.sqrt(squares / count)), sigma, residuals)


def _variances(S: F64) -> F64:
    """Diagonal (m,) of the inverse of S; what the views do not tell is very uncertain, not exact.

    A pseudo-inverse would call it certain.
    """
    scale = np.sqrt(np.maximum(np.diag(S), 1e-300))
    values, vectors = np.linalg.eigh(S / np.outer(scale, scale))
    spread: F64 = (vectors**2 / np.maximum(values, _UNTOLD)).sum(axis=1) / scale**2
    return spread


def _linearise(camera: CameraModel, views: Sequence[View], poses: Sequence[Mat4]) -> _System:
    m = _PINHOLE + len(camera.distortion)
    # All points at once: a call for each view would cost ten times as much.
    pixels = np.concatenate([view.pixels for view in views])
    moved = [_move(T, view.points) for view, T in zip(views, poses, strict=True)]
    residual, J_camera, J_pose = _residual_and_jacobians(camera, pixels, np.concatenate(moved))
    r, Ji, Jv = residual.reshape(-1), J_camera.reshape(-1, m), J_pose.reshape(-1, 6)
    w = _weights(residual)
    weighted = Jv * w[:, None]
    kept: list[tuple[F64, F64, F64]] = []
    begin = 0
    for view in views:
        rows = slice(begin, begin := begin + view.pixels.size)
        kept.append(
            (Jv[rows].T @ weighted[rows], Ji[rows].T @ weighted[rows], weighted[rows].T @ r[rows])
        )
    return _System(_huber(residual), Ji.T @ (Ji * w[:, None]), Ji.T @ (r * w), kept)


def _eliminate(system: _System, damping: float) -> tuple[F64, F64, list[F64]]:
    """S (m, m) and b (m,) of the camera alone, and the inverse (6, 6) of each view's block."""
    S, b = system.H.copy(), system.b.copy()
    inverses: list[F64] = []
    S[np.diag_indices(len(b))] *= 1.0 + damping
    for H_vv, H_iv, b_v in system.views:
        damped = H_vv.copy()
        damped[np.diag_indices(6)] *= 1.0 + damping
        damped[np.diag_indices(6)] += 1e-12 * np.trace(H_vv) + 1e-300
        inverse: F64 = np.linalg.inv(damped).astype(np.float64)
        gain = H_iv @ inverse
        S -= gain @ H_iv.T
        b -= gain @ b_v
        inverses.append(inverse)
    return S, b, inverses


def _step(
    camera: CameraModel, poses: Sequence[Mat4], system: _System, damping: float
) -> tuple[CameraModel, list[Mat4]] | None:
    """The camera and the poses one step on; None where that would be no camera."""
    S, b, inverses = _eliminate(system, damping)
    d = np.linalg.lstsq(S, b, rcond=1e-15)[0]
    moved = with_parameters(camera, parameters_of(camera) + d)
    if moved is None:
        return None
    T = []
    for pose, inverse, (_, H_iv, b_v) in zip(poses, inverses, system.views, strict=True):
        T.append(se3.exp(inverse @ (b_v - H_iv.T @ d)) @ pose)
    return moved, T


def parameters_of(camera: CameraModel) -> F64:
    """Parameters fx fy cx cy and the coefficients (4 + k,)."""
    return np.array([camera.fx, camera.fy, camera.cx, camera.cy, *camera.distortion])


def with_parameters(camera: CameraModel, values: F64) -> CameraModel | None:
    """The camera with other parameters; None where they are impossible."""
    fx, fy, cx, cy, *coefficients = map(float, values)
    try:
        return replace(camera, fx=fx, fy=fy, cx=cx, cy=cy, distortion=tuple(coefficients))
    except ConfigError:
        return None


def _move(T: Mat4, points: F64) -> F64:
    """Points (n, 3) in the frame that T takes them to."""
    return points @ T[:3, :3].T + T[:3, 3]


def _residual_and_jacobians(camera: CameraModel, pixels: F64, p: F64) -> tuple[F64, F64, F64]:
    """Residuals (n, 2) and slopes of the projection by camera (n, 2, 4 + k) and pose (n, 2, 6).

    Of points p (n, 3) in the camera's frame; those that the lens cannot see weigh nothing.
    """
    seen = (p[:, 2] > 1e-6) & (np.hypot(p[:, 0], p[:, 1]) < camera.field_limit * p[:, 2])
    z = np.where(seen, p[:, 2], 1.0)
    a = np.where(seen[:, None], p[:, :2] / z[:, None], 0.0)
    model, coefficients = camera.distortion_model, camera.distortion
    d = distortion.distort(model, coefficients, a)
    focal = np.array([camera.fx, camera.fy])
    residual = pixels - (d * focal + (camera.cx, camera.cy))
    residual[~seen] = 0.0

    n, k = len(p), len(coefficients)
    J_camera = np.zeros((n, 2, _PINHOLE + k))
    J_camera[:, 0, 0], J_camera[:, 1, 1] = d[:, 0], d[:, 1]
    J_camera[:, 0, 2] = J_camera[:, 1, 3] = 1.0
    for j in range(k):
        J_camera[:, :, _PINHOLE + j] = _slope_by_coefficient(model, coefficients, j, a) * focal
    J_plane = np.zeros((n, 2, 3))
    J_plane[:, 0, 0] = J_plane[:, 1, 1] = 1.0 / z
    J_plane[:, :, 2] = -a / z[:, None]
    J_point = np.zeros((n, 3, 6))
    J_point[:, :, :3] = np.eye(3)
    x, y, w = p.T
    J_point[:, 0, 4], J_point[:, 0, 5] = w, -y
    J_point[:, 1, 3], J_point[:, 1, 5] = -w, x
    J_point[:, 2, 3], J_point[:, 2, 4] = y, -x
    J_lens = distortion.jacobian(model, coefficients, a) * focal[:, None]
    J_pose = J_lens @ J_plane @ J_point
    J_camera[~seen], J_pose[~seen] = 0.0, 0.0
    return residual, J_camera, J_pose


def _slope_by_coefficient(model: str, coefficients: tuple[float, ...], j: int, a: F64) -> F64:
    """Slope (n, 2) of the distorted points by coefficient j; the models are linear in most."""
    h = 1e-5
    ahead, behind = list(coefficients), list(coefficients)
    ahead[j] += h
    behind[j] -= h
    return (
        distortion.distort(model, tuple(ahead), a) - distortion.distort(model, tuple(behind), a)
    ) / (2.0 * h)


def _weights(residual: F64) -> F64:
    """Huber weight of each coordinate (2n,): by the length of its point's residual."""
    length = np.linalg.norm(residual, axis=1)
    return np.repeat(np.minimum(1.0, _HUBER_PX / np.maximum(length, 1e-12)), 2)


def _huber(residual: F64) -> float:
    length = np.linalg.norm(residual, axis=1)
    inside = length <= _HUBER_PX
    beyond = 2.0 * _HUBER_PX * length - _HUBER_PX**2
    return float(np.where(inside, length**2, beyond).sum())
