# SPDX-License-Identifier: Apache-2.0
"""Simulated lines before cameras, and what is asked of them."""

from typing import NamedTuple

import numpy as np

from edge.geometry import se3, so3
from edge.lines import pose
from edge.lines.line import Lines, lines_between, segments_between, take_segments
from edge.lines.structure import Structure, Views, triangulate
from edge.markers.pose import believed, corner_points, poses
from edge.types import F64, Mat4, Pinhole

CAMERA = Pinhole(640, 480, 500.0, 500.0, 319.5, 239.5)
_MARKER_M = 0.2
_MARKER_SIGMA_PX = 0.1  # of corners measured by their edges
_VIEWS = 90  # three seconds
_VIEWS_WITH_MARKER = 30
_RADIUS_M, _ASIDE_M = 0.25, 0.3  # of the camera's circle, and how far its middle is off


class Pair(NamedTuple):
    """One trial of a pose: the truth and where the search begins."""

    T: Mat4
    start: Mat4
    ends: F64  # (n, 2, 3)


def project(points: F64) -> F64:
    """Pixels (..., 2) of points (..., 3) in the camera's frame."""
    focal, centre = np.array(CAMERA[2:4]), np.array(CAMERA[4:])
    return np.asarray(focal * points[..., :2] / points[..., 2:] + centre)


def trial(rng: np.random.Generator, n: int, angle_deg: float, *, flat: bool) -> Pair:
    """Lines within a cube of two metres, three metres off; a start turned about their middle."""
    turn = np.r_[rng.normal(0.0, 0.2, 3), rng.normal(0.0, 0.6, 3)]
    T = se3.exp([0, 0, 3.0, 0, 0, 0]) @ se3.exp(turn)
    size = np.array([1.0, 0.8, 0.0 if flat else 1.0])
    found: list[F64] = []
    while len(found) < n:
        first, step = rng.uniform(-size, size), rng.normal(size=3) * (size > 0.0)
        pair = first + np.outer([0.0, rng.uniform(0.3, 1.2) / np.linalg.norm(step)], step)
        if _in_image(se3.transform(T, pair)):
            found.append(pair)
    axis = rng.normal(size=3)
    R = so3.exp(np.deg2rad(angle_deg) * axis / np.linalg.norm(axis)) @ T[:3, :3]
    return Pair(T, se3.from_rotation_translation(R, T[:3, 3]), np.array(found))


def solved(
    rng: np.random.Generator, case: Pair, noise_px: float, noise_m: float
) -> tuple[bool, int, int]:
    """Whether the minimum at the truth was found, how many were, and rounds of one iteration."""
    pixels = project(se3.transform(case.T, case.ends.reshape(-1, 3))).reshape(-1, 4)
    segments = segments_between(pixels + rng.normal(0.0, noise_px, pixels.shape), noise_px)
    known = case.ends + rng.normal(0.0, noise_m, case.ends.shape)
    lines = lines_between(known[:, 0], known[:, 1], noise_m)
    found = pose.solve(lines, segments, CAMERA, case.start)
    ideal = pose.refine(lines, segments, CAMERA, case.T)
    off = found and so3.angle(found[0].T_cam_lines[:3, :3] @ ideal.T_cam_lines[:3, :3].T)
    _, rounds = pose.iterate(lines, segments, CAMERA, case.start)
    return bool(found) and off < np.deg2rad(0.5), len(found), rounds


def plane_error_m(seed: int, noise_px: float, *, given_poses: bool) -> tuple[float, int]:
    """Mean |Z| of lines of a plane a metre off, and how many of them are known.

    A camera held by hand makes one round of 0.5 m. Either its poses are given, or a marker in
    the plane gives those of the first views, and lines found so far those of all others.
    """
    rng = np.random.default_rng(seed)
    ends = rng.uniform([-0.35, -0.25, 0], [0.35, 0.25, 0], (20, 2, 3))
    ends = ends[np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1) > 0.1]
    truth = [_circling(angle) for angle in np.linspace(0.0, 2.0 * np.pi, _VIEWS)]
    seen = []
    for T in truth:
        pixels = project(se3.transform(T, ends.reshape(-1, 3))).reshape(-1, 4)
        seen.append(segments_between(pixels + rng.normal(0.0, noise_px, pixels.shape), noise_px))
    if given_poses:
        found = _structure(seen, truth)
        return _mean_height(found), int(found.known.sum())
    known = [_by_marker(rng, T) for T in truth[:_VIEWS_WITH_MARKER]]
    for segments in seen[_VIEWS_WITH_MARKER:]:
        if len(known) % 5 == 0:
            found = _structure(seen[: len(known)], known)
        good = found.known
        lines = Lines(*(array[good] for array in found.lines))
        here = pose.refine(lines, take_segments(segments, good), CAMERA, known[-1])
        known.append(here.T_cam_lines)
    found = _structure(seen, known)
    return _mean_height(found), int(found.known.sum())


def _circling(angle_rad: float) -> Mat4:
    """T_cam_plane of a camera a metre before the plane that circles and looks at its middle."""
    aside = _RADIUS_M * np.array([np.cos(angle_rad), np.sin(angle_rad)]) + _ASIDE_M
    forward = -np.array([*aside, 1.0]) / np.linalg.norm([*aside, 1.0])
    right = np.cross(forward, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    R = np.array([right, np.cross(forward, right), forward])
    return se3.from_rotation_translation(R, -R @ [*aside, 1.0])


def _by_marker(rng: np.random.Generator, T: Mat4) -> Mat4:
    corners = project(se3.transform(T, corner_points(_MARKER_M)))
    corners = corners + rng.normal(0.0, _MARKER_SIGMA_PX, (4, 2))
    found = believed(poses(corners, _MARKER_M, CAMERA, _MARKER_SIGMA_PX))
    if found is None:
        raise ValueError("the marker is ambiguous from here")
    return found.T_cam_marker


def _structure(seen: list, known: list[Mat4]) -> Structure:
    T = np.array(known)
    views = []
    for k in range(len(seen[0].length)):
        rows = [np.array([segments[c][k] for segments in seen]) for c in range(4)]
        views.append(Views(type(seen[0])(*rows), T))
    return triangulate(views, CAMERA)


def _mean_height(found: Structure) -> float:
    """Mean |Z| [m] of both ends of the known lines."""
    places = found.lines.point[:, None] + found.span[:, :, None] * found.lines.direction[:, None]
    return float(np.mean(np.abs(places[found.known][:, :, 2])))


def _in_image(local: F64) -> bool:
    if local[:, 2].min() < 0.5:
        return False
    pixels = project(local)
    inside = np.all(pixels > 0.0) and np.all(pixels < [CAMERA.width, CAMERA.height])
    return bool(inside and np.linalg.norm(pixels[1] - pixels[0]) > 30.0)
