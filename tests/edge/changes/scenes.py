# SPDX-License-Identifier: Apache-2.0
"""A box of points in front of cameras that look at it."""

import numpy as np
from numpy.typing import NDArray

from edge.geometry.camera import CameraModel
from edge.tiles.labels import MapObject
from edge.types import Detections, Mask

CAMERA = CameraModel(640, 480, 420.0, 420.0, 319.5, 239.5)
HALF_M = 0.1
FRONT = np.array([[0.0, 0.0, -2.0]])  # it was seen from here


def box_object() -> MapObject:
    axis = np.linspace(-HALF_M, HALF_M, 7)
    points = np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3)
    return MapObject(1, points, FRONT, np.array([True]))


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


def ball_detection(
    balls: list[tuple[int, NDArray[np.float64], float]],
    T_map_cam: NDArray[np.float64],
    camera: CameraModel = CAMERA,
) -> Detections:
    """Exact masks of balls (class, centre, radius) that do not hide each other."""
    v, u = np.mgrid[: camera.height, : camera.width].astype(np.float64)
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)], -1)
    rays /= np.linalg.norm(rays, axis=2, keepdims=True)
    boxes, classes, masks = [], [], []
    for label, center, radius in balls:
        local = (center - T_map_cam[:3, 3]) @ T_map_cam[:3, :3]
        distance = np.linalg.norm(local)
        inside = rays @ (local / distance) > np.sqrt(1.0 - (radius / distance) ** 2)
        if not inside.any():
            continue
        rows, columns = np.flatnonzero(inside.any(axis=1)), np.flatnonzero(inside.any(axis=0))
        top, left = int(rows[0]), int(columns[0])
        part = inside[top : rows[-1] + 1, left : columns[-1] + 1]
        masks.append(Mask(left, top, part))
        boxes.append([left - 0.5, top - 0.5, columns[-1] + 0.5, rows[-1] + 0.5])
        classes.append(label)
    return Detections(
        np.array(boxes, np.float32).reshape(-1, 4),
        np.linspace(0.9, 0.6, len(masks)).astype(np.float32),
        np.array(classes, np.int32),
        tuple(masks),
    )


def joined(found: Detections) -> Detections:
    """All masks as one."""
    low = found.boxes[:, :2].min(axis=0)
    high = found.boxes[:, 2:].max(axis=0)
    left, top = np.rint(low + 0.5).astype(int).tolist()
    w, h = np.rint(high - low).astype(int).tolist()
    inside = np.zeros((h, w), bool)
    for mask in found.masks:
        rows, columns = np.nonzero(mask.inside)
        inside[rows + mask.top - top, columns + mask.left - left] = True
    box = np.concatenate([low, high])[None]
    return Detections(box, found.scores[:1], found.classes[:1], (Mask(left, top, inside),))
