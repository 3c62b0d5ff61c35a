# SPDX-License-Identifier: Apache-2.0
"""Which objects of a map may be in an image: of a large map, few are."""

from collections.abc import Sequence

import numpy as np

from edge.geometry.camera import CameraModel
from edge.tiles.labels import MapObject
from edge.types import Mat4

_SLACK_RAD = 1e-3


class InView:
    """Finds objects within the cone that holds all that a camera sees."""

    def __init__(self, things: Sequence[MapObject], camera: CameraModel) -> None:
        self._centers = np.array([thing.center for thing in things]).reshape(-1, 3)
        self._radii = np.array([_radius(thing) for thing in things])
        self._cone_rad = _cone(camera)

    def of(self, T_map_cam: Mat4) -> list[int]:
        """Numbers of those that may show, in their order; others surely do not."""
        away = self._centers - T_map_cam[:3, 3]
        distance = np.maximum(np.linalg.norm(away, axis=1), 1e-9)
        angle = np.arccos(np.clip(away @ T_map_cam[:3, 2] / distance, -1.0, 1.0))
        spans = np.arcsin(np.minimum(self._radii / distance, 1.0))
        spans[self._radii >= distance] = np.pi  # the camera is inside
        return np.flatnonzero(angle - spans <= self._cone_rad).tolist()


def _radius(thing: MapObject) -> float:
    return float(np.linalg.norm(thing.points - thing.center, axis=1).max())


def _cone(camera: CameraModel) -> float:
    """Largest angle from the axis of what the image shows [rad]; all round where nobody knows."""
    u, v = np.arange(0.0, camera.width, 4.0), np.arange(0.0, camera.height, 4.0)
    right, bottom = camera.width - 1.0, camera.height - 1.0
    border = [(x, y) for x in (*u, right) for y in (0.0, bottom)]
    border += [(x, y) for x in (0.0, right) for y in (*v, bottom)]
    rays = camera.undistort(camera.normalise(np.array(border)))
    if not np.isfinite(rays).all():
        return float(np.pi)
    return float(np.arctan(np.hypot(*rays.T).max())) + _SLACK_RAD
