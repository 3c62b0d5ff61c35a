# SPDX-License-Identifier: Apache-2.0
"""The ChArUco board that cameras are calibrated with: found in images, and drawn to be printed."""

from typing import NamedTuple

import cv2
import numpy as np

from edge.errors import ConfigError
from edge.geometry.calibration import View
from edge.types import F64, U8

_MIN_CORNERS = 8  # fewer hardly tell a pose
_PIXELS_PER_SQUARE = 200


class BoardSpec(NamedTuple):
    """A board as it was printed."""

    columns: int  # squares
    rows: int
    square_m: float
    marker_m: float
    dictionary: str = "DICT_4X4_50"


class Board:
    """Finds its corners in images. Owned by one thread."""

    def __init__(self, spec: BoardSpec) -> None:
        self.spec = spec
        name = spec.dictionary.upper()
        if not name.startswith("DICT_") or not hasattr(cv2.aruco, name):
            known = sorted(n for n in dir(cv2.aruco) if n.startswith("DICT_") and n.isupper())
            raise ConfigError(
                f"--dictionary {spec.dictionary}: is unknown; known are {', '.join(known)}"
            )
        if not 0.0 < spec.marker_m < spec.square_m:
            raise ConfigError(
                f"--marker {spec.marker_m:g}: must be above 0 and below the square's "
                f"{spec.square_m:g}"
            )
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))
        size = (spec.columns, spec.rows)
        if spec.columns * spec.rows // 2 > len(dictionary.bytesList):
            raise ConfigError(
                f"--dictionary {spec.dictionary}: has too few markers for "
                f"{spec.columns}x{spec.rows} squares: take a larger one"
            )
        self._board = cv2.aruco.CharucoBoard(size, spec.square_m, spec.marker_m, dictionary)
        self._detector = cv2.aruco.CharucoDetector(self._board)
        self._corners = np.asarray(self._board.getChessboardCorners(), np.float64).reshape(-1, 3)

    @property
    def corners(self) -> F64:
        """All inner corners (n, 3) in the board's frame [m], z = 0."""
        return self._corners

    def find(self, image: U8) -> View | None:
        """The corners that a grey image shows; None where they are too few, or all on a line."""
        pixels, ids, _, _ = self._detector.detectBoard(image)
        if ids is None or len(ids) < _MIN_CORNERS:
            return None
        points = self._corners[np.asarray(ids).ravel()]
        if np.linalg.matrix_rank(points[:, :2] - points[0, :2]) < 2:
            return None
        return View(points, np.asarray(pixels, np.float64).reshape(-1, 2))

    def draw(self) -> U8:
        """A picture (h, w) uint8 to be printed, a white square around it."""
        size = (
            (self.spec.columns + 2) * _PIXELS_PER_SQUARE,
            (self.spec.rows + 2) * _PIXELS_PER_SQUARE,
        )
        image: U8 = np.asarray(self._board.generateImage(size, marginSize=_PIXELS_PER_SQUARE))
        return image
