# SPDX-License-Identifier: Apache-2.0
"""Square markers (ArUco, AprilTag) in images."""

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from edge.errors import ConfigError
from edge.markers.edges import refine_corners
from edge.types import F64, U8


class Marker(NamedTuple):
    """One marker in one image."""

    number: int
    corners: F64  # (4, 2) raw pixels: from its upper left one, clockwise


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


def _dictionary(family: str) -> cv2.aruco.Dictionary:
    name = family.upper().removeprefix("DICT_")
    if name not in families():
        raise ConfigError(f"marker family {family!r} is unknown; known are {', '.join(families())}")
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{name}"))


def _parameters() -> cv2.aruco.DetectorParameters:
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    return parameters
