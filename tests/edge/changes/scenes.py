"""A box of points in front of cameras that look at it."""

import numpy as np
from numpy.typing import NDArray

from edge.changes.expect import MapObject
from edge.geometry.camera import CameraModel
from edge.types import Detections, Mask

CAMERA = CameraModel(640, 480, 420.0, 420.0, 319.5, 239.5)
HALF_M = 0.1
FRONT = np.array([[0.0, 0.0, -1.0]])  # it was seen from here


def box_object(hit_rate: float = 0.8) -> MapObject:
    axis = np.linspace(-HALF_M, HALF_M, 7)
    points = np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3)
    return MapObject(1, points, FRONT, 2.0, hit_rate)


def look_at_origin(angle_rad: float, distance_m: float) -> NDArray[np.float64]:
    """Pose of a camera on a circle around the box, at 0 in front of it."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    T = np.eye(4)
    T[:3, :3] = [[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]]
    T[:3, 3] = -distance_m * T[:3, 2]
    return T


def detection(left: int, top: int, right: int, bottom: int) -> Detections:
    """One detection whose mask fills a box of pixels."""
    return Detections(
        np.array([[left, top, right, bottom]], np.float32) - 0.5,
        np.array([0.8], np.float32),
        np.array([5], np.int32),
        (Mask(left, top, np.ones((bottom - top, right - left), dtype=bool)),),
    )


NOTHING = Detections(
    np.zeros((0, 4), np.float32), np.zeros(0, np.float32), np.zeros(0, np.int32), ()
)
