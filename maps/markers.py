# SPDX-License-Identifier: Apache-2.0
"""Square markers (ArUco, AprilTag) in images, and where their corners lie in a map."""

from collections.abc import Iterable, Iterator
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from edge.errors import ConfigError
from edge.types import F64, U8, Mat4
from maps.marker_edges import refine_corners

# Rays that meet at a smaller angle say little about a distance.
_MIN_PARALLAX_RAD = np.deg2rad(3.0)
_ROUNDS = 3  # of weights that follow the distance


class Marker(NamedTuple):
    """One marker in one image."""

    number: int
    corners: F64  # (4, 2) raw pixels: from its upper left one, clockwise


class Sighting(NamedTuple):
    """A marker as a posed camera sees it."""

    T_map_cam: Mat4
    number: int
    corners: F64  # (4, 2) on the normalised plane, without the lens


class MarkerFinder:
    """Finds the markers of one family."""

    def __init__(self, family: str) -> None:
        dictionary = _dictionary(family)
        self._modules = dictionary.markerSize + 2
        self._detector = cv2.aruco.ArucoDetector(dictionary, _parameters())

    def find(self, image: U8) -> list[Marker]:
        """Markers of an image (h, w); those whose number occurs twice are left out."""
        corners, numbers, _ = self._detector.detectMarkers(image)
        found = [] if numbers is None else np.asarray(numbers).ravel().tolist()
        return [
            Marker(number, self._refined(image, square))
            for number, square in zip(found, corners, strict=True)
            if found.count(number) == 1
        ]

    def _refined(self, image: U8, square: NDArray[np.float32]) -> F64:
        corners = np.asarray(square, np.float64).reshape(4, 2)
        return refine_corners(image, corners, self._modules)


def families() -> list[str]:
    """Names of the families that are known, as 4X4_50 or APRILTAG_36H11."""
    names = (name for name in dir(cv2.aruco) if name.startswith("DICT_"))
    return sorted({name.removeprefix("DICT_").upper() for name in names})


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


def _dictionary(family: str) -> cv2.aruco.Dictionary:
    name = family.upper().removeprefix("DICT_")
    if name not in families():
        raise ConfigError(f"marker family {family!r} is unknown; known are {', '.join(families())}")
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{name}"))


def _parameters() -> cv2.aruco.DetectorParameters:
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    return parameters


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
