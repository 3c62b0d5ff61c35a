# SPDX-License-Identifier: Apache-2.0
"""A patterned plate before a patterned wall, drawn exactly for any camera."""

import numpy as np

from edge.geometry.camera import CameraModel
from edge.tiles.labels import MapObject
from edge.types import F64, U8, Mat4
from tests.edge.changes.scenes import look_at_origin

SIDE_M, WALL_M = 0.24, 0.1  # of the plate; the wall is so far behind it
PLATE, OTHER = 1, 7


def pattern(seed: int, xy: F64) -> F64:
    """Smooth brightness at places (..., 2) of a plane."""
    rng = np.random.default_rng(seed)
    waves, phases = rng.normal(0.0, 25.0, (12, 2)), rng.uniform(0.0, 6.3, 12)
    shades: F64 = 120.0 + 22.0 * np.cos(xy @ waves.T + phases).sum(axis=-1) / np.sqrt(6.0)
    return shades


def draw(camera: CameraModel, T: Mat4, plate: int | None, center: tuple[float, float]) -> U8:
    """The scene with `plate` at x, y of the plane z = 0; None: the wall alone."""
    v, u = np.mgrid[: camera.height, : camera.width].astype(np.float64)
    pixels = np.column_stack([u.ravel(), v.ravel()])
    rays = camera.undistort(camera.normalise(pixels))
    rays = np.column_stack([rays, np.ones(len(rays))]) @ T[:3, :3].T
    at_wall = T[:3, 3] + rays * ((WALL_M - T[2, 3]) / rays[:, 2])[:, None]
    grey = pattern(0, at_wall[:, :2])
    if plate is not None:
        at = T[:3, 3] + rays * (-T[2, 3] / rays[:, 2])[:, None]
        flat = at[:, :2] - center
        on = (np.abs(flat) < 0.5 * SIDE_M).all(axis=1)
        grey[on] = pattern(plate, flat[on])
    return np.clip(np.rint(grey), 0, 255).astype(np.uint8).reshape(camera.height, camera.width)


def plate_object(poses: list[Mat4]) -> MapObject:
    """The plate as a map knows it, found from all `poses`."""
    axis = np.linspace(-0.5 * SIDE_M, 0.5 * SIDE_M, 9)
    x, y = np.meshgrid(axis, axis)
    points = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    return MapObject(1, points, np.stack([T[:3, 3] for T in poses]), np.ones(len(poses), bool))


def around(degrees: list[float], distance_m: float = 1.6) -> list[Mat4]:
    return [look_at_origin(np.radians(angle), distance_m) for angle in degrees]
