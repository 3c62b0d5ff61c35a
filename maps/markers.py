# SPDX-License-Identifier: Apache-2.0
"""Where the corners of square markers lie in a map."""

from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np

from edge.geometry import se3, so3
from edge.geometry.camera import CameraModel
from edge.markers.finder import MarkerFinder
from edge.types import F64, U8, Mat4

# Rays that meet at a smaller angle say little about a distance.
_MIN_PARALLAX_RAD = np.deg2rad(3.0)
_ROUNDS = 3  # of weights that follow the distance


class MarkerImage(NamedTuple):
    """An image that may show markers, and where it was taken."""

    image: U8 | None  # None where it cannot be read
    camera: CameraModel
    T_map_cam: Mat4


class Sighting(NamedTuple):
    """A marker as a posed camera sees it."""

    T_map_cam: Mat4
    number: int
    corners: F64  # (4, 2) on the normalised plane, without the lens


def sightings_in(images: Iterable[MarkerImage], family: str) -> list[Sighting]:
    """All that is seen of a family's markers; ConfigError where there is no such family."""
    finder = MarkerFinder(family)
    found = []
    for image, camera, T_map_cam in images:
        for marker in finder.find(image) if image is not None else ():
            corners = camera.undistort(camera.normalise(marker.corners))
            if np.isfinite(corners).all():
                found.append(Sighting(T_map_cam, marker.number, corners))
    return found


def squares(sightings: Iterable[Sighting]) -> Iterator[tuple[int, F64]]:
    """Number and corners (4, 3) in the map of each marker that is seen from two sides."""
    by_number: dict[int, list[Sighting]] = {}
    for sighting in sightings:
        by_number.setdefault(sighting.number, []).append(sighting)
    for number, seen in sorted(by_number.items()):
        centres = np.array([sighting.T_map_cam[:3, 3] for sighting in seen])
        rays = np.array([_rays(sighting) for sighting in seen])
        corners = [_meeting_point(centres, rays[:, k]) for k in range(4)]
        if all(corner is not None for corner in corners):
            yield number, np.array(corners)


def sides(square: F64) -> F64:
    """Lengths (4,) of the sides of a square's corners (4, 3)."""
    lengths: F64 = np.linalg.norm(np.roll(square, -1, axis=0) - square, axis=1)
    return lengths


def pose_of(corners: F64, *, on_wall: bool) -> Mat4:
    """T_map_local of a marker's corners (4, 3), clockwise from the upper left of its print."""
    right = corners[1] + corners[2] - corners[0] - corners[3]
    up = corners[0] + corners[1] - corners[2] - corners[3]
    axes = (right, -np.cross(right, up), up) if on_wall else (right, up, np.cross(right, up))
    R = so3.normalise(np.stack([axis / np.linalg.norm(axis) for axis in axes], axis=1))
    return se3.from_rotation_translation(R, corners.mean(axis=0))


def _rays(sighting: Sighting) -> F64:
    """Unit directions (4, 3) in the map."""
    local = np.column_stack((sighting.corners, np.ones(4)))
    rays = local @ sighting.T_map_cam[:3, :3].T
    unit: F64 = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    return unit


def _meeting_point(centres: F64, rays: F64) -> F64 | None:
    """The point (3,) nearest to rays (n, 3) from centres (n, 3) by angle; None if too parallel."""
    cosine = np.clip(rays @ rays.T, -1.0, 1.0)
    if np.arccos(cosine.min()) < _MIN_PARALLAX_RAD:
        return None
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    weights = np.ones(len(rays))
    point = np.zeros(3)
    for _ in range(_ROUNDS):
        A = np.einsum("n,nij->ij", weights, across)
        point = np.linalg.solve(A, np.einsum("n,nij,nj->i", weights, across, centres))
        weights = 1.0 / np.maximum(np.sum((point - centres) ** 2, axis=1), 1e-12)
    return point
