# SPDX-License-Identifier: Apache-2.0
"""A camera pose from lines in space and the segments that show them."""

from typing import NamedTuple

import numpy as np

from edge.geometry import so3
from edge.geometry.se3 import from_rotation_translation
from edge.lines import kernels_iteration, kernels_residual
from edge.lines.line import Lines, Segments, across, plane_normals
from edge.types import F64, Mat4, Mat6, Pinhole

_ROUNDS = 200
_DONE = 1e-4  # gain of a round, as a share of the cost, at which refinement takes over
_WEIGHTINGS = 3  # times that weights follow the depths and residuals of the pose
_REFINE_STEPS = 30
_NO_KERNEL = 1e12
_WIDE = 100.0  # times the kernel's squared scale, while wrong pairs may still pull
# A pose that leaves the pairs further off than this is at a wrong minimum; others are looked for
# from starts turned by so much about each axis.
_EXPLAINED = 6.0
_TURNS = np.deg2rad(45.0) * np.vstack((np.eye(3), -np.eye(3)))
# Lines within such a share of their spread of one plane may have a second minimum.
_FLAT = 0.1
# Known worse than by the distance of the scene, or by a radian: not known.
_UNKNOWN = 1.0
_MIN_INFORMATION = 1e-12


class LinePose(NamedTuple):
    """A minimum of the cost, as camera-from-lines transform."""

    T_cam_lines: Mat4
    covariance: Mat6  # of the twist on the left; huge along `open`
    open: F64  # (k, 6) unit twists (translation in distances of the scene) that lines do not hold
    cost: float  # robust, in squared sigmas
    m2: F64  # (n,) squared Mahalanobis distance of each pair, two degrees of freedom


def iterate(
    lines: Lines, segments: Segments, camera: Pinhole, T_cam_lines: Mat4, max_rounds: int = _ROUNDS
) -> tuple[Mat4, int]:
    """Pose where the orthogonal iteration from `T_cam_lines` comes to rest, and its rounds.

    All pairs weigh the same. See `edge.lines.kernels_iteration` for the method and its sources.
    """
    solver = _Solver(lines, segments, camera, np.inf)
    return solver.iterate(T_cam_lines, np.ones(len(lines.point)), max_rounds)


def refine(
    lines: Lines,
    segments: Segments,
    camera: Pinhole,
    T_cam_lines: Mat4,
    cauchy2: float = 9.0,
) -> LinePose:
    """Best pose near one that is right within some ten pixels; weights by both covariances."""
    return _Solver(lines, segments, camera, cauchy2).refined(T_cam_lines, cauchy2)


def solve(
    lines: Lines,
    segments: Segments,
    camera: Pinhole,
    T_cam_lines: Mat4,
    cauchy2: float = 9.0,
) -> list[LinePose]:
    """Poses that explain the pairs, best first, from a start that may be far off.

    lines, segments : n pairs, the i-th segment shows the i-th line; n at least 3
    T_cam_lines : (4, 4) any pose from which the lines lie in front of the camera
    cauchy2 : squared scale [sigmas^2] beyond which a pair loses its weight

    Two poses come back only where the lines are nearly in one plane and both its tilts are
    minima; who uses one must see that the second is clearly worse. None comes back where every
    pose that was found has the lines behind the camera.
    """
    solver = _Solver(lines, segments, camera, cauchy2)
    first = solver.from_afar(T_cam_lines)
    for turn in _TURNS:
        if np.median(first.m2) < _EXPLAINED:
            break
        other = solver.from_afar(_turned(T_cam_lines, lines, turn))
        first = min(first, other, key=lambda pose: pose.cost)
    found = [first]
    if solver.flatness < _FLAT:
        mirrored = solver.from_afar(_mirrored(first.T_cam_lines, lines, solver.normal))
        if not _same(first.T_cam_lines, mirrored.T_cam_lines, lines):
            found.append(mirrored)
    seen = [pose for pose in found if _is_in_front(pose.T_cam_lines, lines)]
    return sorted(seen, key=lambda pose: pose.cost)


class _Solver:
    """The pairs, in the form that kernels take."""

    def __init__(self, lines: Lines, segments: Segments, camera: Pinhole, cauchy2: float) -> None:
        self._lines, self._camera, self._cauchy2 = lines, camera, cauchy2
        self._normals = plane_normals(segments, camera)
        self._centre = lines.point.mean(axis=0)
        spread = np.sqrt(np.mean(np.sum((lines.point - self._centre) ** 2, axis=1)))
        self._scale = max(float(spread), 1e-9)
        self._segments, self._basis = segments, across(lines.direction)
        self.normal, self.flatness = _normal_and_flatness(lines)

    def iterate(self, T: Mat4, weights: F64, max_rounds: int) -> tuple[Mat4, int]:
        """Orthogonal iteration, with points in units of their spread about their middle."""
        R, t = T[:3, :3].copy(), (T[:3, 3] + T[:3, :3] @ self._centre) / self._scale
        points = (self._lines.point - self._centre) / self._scale
        _, rounds = kernels_iteration.iterate(
            self._normals, points, self._lines.direction, weights, weights, max_rounds, _DONE, R, t
        )
        return from_rotation_translation(R, self._scale * t - R @ self._centre), rounds

    def from_afar(self, T: Mat4) -> LinePose:
        """Iteration with weights that follow the residuals, then refinement."""
        weights = np.ones(len(self._lines.point))
        for _ in range(_WEIGHTINGS):
            T, _ = self.iterate(T, weights, _ROUNDS)
            T = self._in_front(T)
            m2 = self.refined(T, np.inf, max_steps=0).m2
            scale2 = max(float(np.median(m2)), self._cauchy2)
            weights = 1.0 / (1.0 + m2 / scale2)
        T = self.refined(T, _WIDE * self._cauchy2).T_cam_lines
        return self.refined(self._in_front(T), self._cauchy2)

    def refined(self, T: Mat4, cauchy2: float, max_steps: int = _REFINE_STEPS) -> LinePose:
        """Minimum near T, in pixels and with both covariances; without steps, what T is worth."""
        # Steps only turn it: what a start lacks of a rotation would stay and grow by and by.
        R, t = so3.normalise(T[:3, :3]), T[:3, 3].copy()
        H, m2 = np.empty((6, 6)), np.empty(len(self._lines.point))
        cost = kernels_residual.refine(
            *self._segments,
            self._lines.point,
            self._lines.direction,
            self._basis,
            self._lines.covariance,
            np.ones(len(m2)),
            self._camera,
            R,
            t,
            min(cauchy2, _NO_KERNEL),
            max_steps,
            H,
            m2,
        )
        T = from_rotation_translation(R, t)
        distance = float(np.linalg.norm(R @ self._centre + t))
        return LinePose(T, *_covariance(H, max(distance, 1e-9)), cost, m2)

    def _in_front(self, T: Mat4) -> Mat4:
        """The pose, or where most lines are behind the camera, its twin that faces them."""
        if _is_in_front(T, self._lines):
            return T
        # Lines of a plane look just the same from its twin behind, turned about its normal.
        R = T[:3, :3] @ (2.0 * np.outer(self.normal, self.normal) - np.eye(3))
        middle = -(T[:3, :3] @ self._centre + T[:3, 3])
        return from_rotation_translation(R, middle - R @ self._centre)


def _covariance(H: Mat6, distance: float) -> tuple[Mat6, F64]:
    """Inverse of H, and the twists along which it says too little."""
    unit = np.repeat([distance, 1.0], 3)
    values, vectors = np.linalg.eigh(H * unit[:, None] * unit)
    inverse = vectors / np.maximum(values, _MIN_INFORMATION) @ vectors.T
    is_open = values < 1.0 / _UNKNOWN**2
    return inverse * unit[:, None] * unit, vectors[:, is_open].T.copy()


def _is_in_front(T: Mat4, lines: Lines) -> bool:
    return bool(np.median(lines.point @ T[2, :3] + T[2, 3]) > 0.0)


def _normal_and_flatness(lines: Lines) -> tuple[F64, float]:
    """Normal (3,) of the plane nearest to all lines, and how far off they are by their spread."""
    centred = lines.point - lines.point.mean(axis=0)
    spread = max(float(np.sqrt(np.mean(np.sum(centred**2, axis=1)))), 1e-12)
    _, values, axes = np.linalg.svd(np.vstack((centred / spread, lines.direction)))
    return np.asarray(axes[2]), float(values[2] / max(values[1], 1e-12))


def _turned(T: Mat4, lines: Lines, turn: F64) -> Mat4:
    """The pose with the lines turned about their middle by a rotation vector."""
    centre = T[:3, :3] @ lines.point.mean(axis=0) + T[:3, 3]
    R = so3.exp(turn)
    return from_rotation_translation(R @ T[:3, :3], R @ (T[:3, 3] - centre) + centre)


def _mirrored(T: Mat4, lines: Lines, normal: F64) -> Mat4:
    """The other pose from which a plane looks alike from afar (Schweighofer and Pinz 2006).

    Depths mirrored at the middle, and the plane's two sides exchanged: two reflections.
    """
    centre = T[:3, :3] @ lines.point.mean(axis=0) + T[:3, 3]
    ray = centre / np.linalg.norm(centre)
    tilt = T[:3, :3] @ normal
    R = (np.eye(3) - 2.0 * np.outer(ray, ray)) @ (np.eye(3) - 2.0 * np.outer(tilt, tilt))
    return from_rotation_translation(R @ T[:3, :3], R @ (T[:3, 3] - centre) + centre)


def _same(A: Mat4, B: Mat4, lines: Lines) -> bool:
    """Whether two poses differ by less than 0.5 degrees and one per cent of the distance."""
    cosine = 0.5 * (np.trace(A[:3, :3].T @ B[:3, :3]) - 1.0)
    middle = lines.point.mean(axis=0)
    a, b = A[:3, :3] @ middle + A[:3, 3], B[:3, :3] @ middle + B[:3, 3]
    near = np.linalg.norm(a - b) < 0.01 * np.linalg.norm(a)
    return bool(cosine > np.cos(np.deg2rad(0.5)) and near)
