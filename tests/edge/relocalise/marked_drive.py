# SPDX-License-Identifier: Apache-2.0
"""A drive along a painted wall on which a marker hangs."""

import cv2
import numpy as np

from edge.config.markers import MarkerPlace, MarkersConfig
from edge.geometry import se3
from edge.types import U8, Frame, Mat4
from tests.maps.wall_drive import PIXELS_PER_M, WALL_SIZE_PX, WALL_Z_M, picture, wall

NUMBER = 7
SIDE_PX = 96
SIDE_M = SIDE_PX / PIXELS_PER_M
CORNER = (650, 330)  # of the paint [px]
# x right, y up, z towards the camera: the map is the world of the wall, with y down.
T_MAP_MARKER = np.diag([1.0, -1.0, -1.0, 1.0])
T_MAP_MARKER[:3, 3] = (
    (CORNER[0] + 0.5 * SIDE_PX - 0.5 - 0.5 * WALL_SIZE_PX[0]) / PIXELS_PER_M,
    (CORNER[1] + 0.5 * SIDE_PX - 0.5 - 0.5 * WALL_SIZE_PX[1]) / PIXELS_PER_M,
    WALL_Z_M,
)


def paint() -> U8:
    """The wall with the marker and its white rim."""
    image = wall(1)
    x, y = CORNER
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    image[y - 16 : y + SIDE_PX + 16, x - 16 : x + SIDE_PX + 16] = 235
    image[y : y + SIDE_PX, x : x + SIDE_PX] = cv2.aruco.generateImageMarker(
        dictionary, NUMBER, SIDE_PX
    )
    return image


def pose(k: int) -> Mat4:
    """T_map_cam: to and fro a metre before the wall, always with the marker in view."""
    a = 0.07 * k
    T = se3.exp([0, 0, 0, 0.05 * np.sin(a), -0.35 * np.sin(a), 0.03 * np.sin(1.3 * a)])
    T[:3, 3] = [0.25 + 0.45 * np.sin(a), 0.1 * np.sin(1.7 * a), 0.9 + 0.1 * np.cos(a)]
    return T


def frames(n: int) -> tuple[list[Frame], list[Mat4]]:
    """Twenty images a second, and where they were taken."""
    shown = paint()
    poses = [pose(k) for k in range(n)]
    return [Frame(k, 50_000_000 * k, picture(shown, T)) for k, T in enumerate(poses)], poses


def settings(*, placed: bool) -> MarkersConfig:
    """The marker, its place with it or not."""
    place = MarkerPlace(number=NUMBER)
    if placed:
        x, y, z = T_MAP_MARKER[:3, 3].tolist()
        place = MarkerPlace(number=NUMBER, position_m=(x, y, z), rotation_xyzw=(1.0, 0.0, 0.0, 0.0))
    return MarkersConfig(family="4X4_50", side_m=SIDE_M, known=(place,))
