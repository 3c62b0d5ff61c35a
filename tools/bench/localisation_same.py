# SPDX-License-Identifier: Apache-2.0
"""Whether what a fix rests on stands the same in two simulated rooms: then it is no false one.

Rooms of one style share walls and doors. An image of one room that shows little else is rightly
found in a map of the other: at the very place where it was taken, as both rooms have one frame.
"""

import json
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from edge.geometry import se3
from edge.geometry.camera import CameraModel
from edge.types import F32, F64, Mat4
from tools.simworld.renderer import Tracer
from tools.simworld.rooms import make_room
from tools.simworld.world import World

# Of a surface in one room from where the other has it, seen from where the fix has the camera.
SAME_WITHIN_M = 0.03
SAME_SHARE = 0.5  # of the matches that the fix rests on


def world_of(recording: Path) -> World | None:
    """The room that a simulated recording was made in, as far as its shape goes."""
    file = recording / "info.json"
    if not file.exists():
        return None
    about = json.loads(file.read_text())
    if "style" not in about or about.get("changes"):
        return None
    return make_room(int(about["seed"]), str(about["style"]))


class SameSurface:
    """Compares what a camera sees in one room with what it would see in another."""

    def __init__(self, here: World, there: World, camera: CameraModel) -> None:
        self._here, self._there = Tracer(here, camera), Tracer(there, camera)
        self._camera = camera

    def share(self, T_true: Mat4, T_found: Mat4, pixels: F32) -> float:
        """Of ideal pixels (n, 2), the share whose surface is at the same place in both rooms.

        In the one room it is seen from the true pose, in the other from the found one.
        """
        ideal = self._camera.normalise(pixels.astype(np.float64))
        u, v = np.rint(self._camera.denormalise(self._camera.distort(ideal))).astype(np.int64).T
        inside = (u >= 0) & (v >= 0) & (u < self._camera.width) & (v < self._camera.height)
        if not inside.any():
            return 0.0
        seen = ideal[inside], u[inside], v[inside]
        apart = _points(self._here, T_true, *seen) - _points(self._there, T_found, *seen)
        return float(np.mean(np.linalg.norm(apart, axis=1) < SAME_WITHIN_M))


def _points(
    tracer: Tracer, T_world_cam: Mat4, ideal: F64, u: NDArray[np.int64], v: NDArray[np.int64]
) -> F64:
    """What is seen at pixels, as points (n, 3) of the room; nan where nothing is."""
    depth = tracer.trace(T_world_cam).depth_m[v, u]
    depth = np.where(depth > 0.0, depth, np.nan)
    rays = np.column_stack((ideal, np.ones(len(ideal))))
    return se3.transform(T_world_cam, rays * depth[:, None])
