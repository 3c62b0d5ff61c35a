# SPDX-License-Identifier: Apache-2.0
"""One mask as a line of sight: where it points, and how much it spans."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from edge.geometry.camera import CameraModel
from edge.types import F64, Detections, Mask, Mat4

_EDGE_PX = 3  # a mask that comes so near to the border goes on beyond it


class Glimpse(NamedTuple):
    """What one image shows of one thing."""

    label: int
    score: float
    mask: Mask
    T_map_cam: Mat4
    camera: CameraModel
    ray: F64  # (3,) unit, in the map, to the middle of the mask
    spread_rad: float  # half of what it spans, as if it were round
    reach_rad: float  # half of the diagonal of its box
    is_whole: bool  # no border of the image cuts it
    distance_m: float  # along the ray, measured somehow; NaN where unknown
    distance_sigma_m: float
    is_faint: bool = False  # the model was less sure than it must be to tell of anything

    @property
    def origin(self) -> F64:
        """The camera's place (3,) in the map [m]."""
        place: F64 = self.T_map_cam[:3, 3]
        return place


# Distance of what a mask holds, and its deviation [m]; NaN where unknown.
Ranger = Callable[[Mask], tuple[float, float]]


def unknown_range(_mask: Mask) -> tuple[float, float]:
    """No distance."""
    return float("nan"), float("nan")


def glimpses(
    detections: Detections,
    T_map_cam: Mat4,
    camera: CameraModel,
    ranger: Ranger = unknown_range,
    *,
    are_faint: bool = False,
) -> list[Glimpse]:
    """All masks of an image, in their order."""
    focal = np.sqrt(camera.fx * camera.fy)
    found = []
    for i, mask in enumerate(detections.masks):
        rows, columns = np.nonzero(mask.inside)
        middle = np.array([[columns.mean() + mask.left, rows.mean() + mask.top]])
        local = np.append(camera.undistort(camera.normalise(middle))[0], 1.0)
        depth, sigma = ranger(mask)
        length = float(np.linalg.norm(local))
        h, w = mask.inside.shape
        # Seen aside, a pixel spans less.
        scale = 1.0 / (focal * length)
        found.append(
            Glimpse(
                label=int(detections.classes[i]),
                score=float(detections.scores[i]),
                mask=mask,
                T_map_cam=T_map_cam,
                camera=camera,
                ray=T_map_cam[:3, :3] @ (local / length),
                spread_rad=float(np.sqrt(len(rows) / np.pi) * scale),
                reach_rad=float(0.5 * np.hypot(h, w) * scale),
                is_whole=_is_whole(mask, camera),
                distance_m=depth * length,
                distance_sigma_m=sigma * length,
                is_faint=are_faint,
            )
        )
    return found


def _is_whole(mask: Mask, camera: CameraModel) -> bool:
    h, w = mask.inside.shape
    return (
        min(mask.left, mask.top) > _EDGE_PX
        and mask.left + w < camera.width - _EDGE_PX
        and mask.top + h < camera.height - _EDGE_PX
    )
