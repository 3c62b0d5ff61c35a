# SPDX-License-Identifier: Apache-2.0
"""One exact image of a world from one place."""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import distance_transform_edt

from edge.geometry.camera import CameraModel
from edge.types import F32, F64, I32, U8
from tools.simworld.kernels_edges import mark_edges
from tools.simworld.kernels_render import shade_image, trace_image
from tools.simworld.kernels_trace import FACES, Scene
from tools.simworld.packing import pack, pack_prims
from tools.simworld.world import World


@dataclass(frozen=True, slots=True, eq=False)
class Traced:
    """What lies at each pixel's centre."""

    depth_m: F64  # (h, w) along the optical axis, 0 = nothing there
    ids: I32  # (h, w) instance, 0 = nothing there


@dataclass(frozen=True, slots=True, eq=False)
class Rendered(Traced):
    """What the camera sees; nothing of it is rounded yet but `bgr`."""

    colour: F32  # (h, w, 3) BGR, gamma coded, [0, 255] or above where it would burn out

    @property
    def bgr(self) -> U8:
        """The picture as 8 bits (h, w, 3)."""
        return np.clip(np.rint(self.colour), 0, 255).astype(np.uint8)


class Tracer:
    """Depths and ids of a world for one camera. Holds no state: threads may share it."""

    def __init__(self, world: World, camera: CameraModel) -> None:
        self.world = world
        self.camera = camera
        self._prims = pack_prims(world)
        rays = camera_rays(camera)
        self._seen: U8 = np.isfinite(rays[:-1, :-1, 0]).astype(np.uint8)
        self._rays = _fill(rays)
        self._ids = np.array([t.id for t in world.things for _ in t.parts] + [0], np.int32)

    def trace(self, T_world_cam: F64) -> Traced:
        """What is seen from T_world_cam, (4, 4), or (h, 4, 4) with one pose for each row."""
        key, depth = self._trace(*self._rows(T_world_cam))
        return Traced(depth, self._instances(key))

    def _rows(self, T_world_cam: F64) -> tuple[F64, F64]:
        rows = np.broadcast_to(T_world_cam, (self.camera.height, 4, 4))
        return np.ascontiguousarray(rows[:, :3, :3]), np.ascontiguousarray(rows[:, :3, 3])

    def _trace(self, R: F64, p: F64) -> tuple[I32, F64]:
        size = (self.camera.height, self.camera.width)
        key, depth = np.empty(size, np.int32), np.empty(size)
        trace_image(self._prims, self._rays, self._seen, R, p, key, depth)
        return key, depth

    def _instances(self, key: I32) -> I32:
        return self._ids[np.where(key >= 0, key // FACES, -1)]


class Renderer(Tracer):
    """Pictures too: its world is painted and lit once, which takes seconds."""

    def __init__(self, world: World, camera: CameraModel, scene: Scene | None = None) -> None:
        super().__init__(world, camera)
        self._scene = scene or pack(world)

    def through(self, camera: CameraModel) -> "Renderer":
        """The same world seen by another camera, without painting it anew."""
        return Renderer(self.world, camera, self._scene)

    def render(self, T_world_cam: F64) -> Rendered:
        """The view from T_world_cam, (4, 4), or (h, 4, 4) with one pose for each row."""
        R, p = self._rows(T_world_cam)
        key, depth = self._trace(R, p)
        edge = np.empty(key.shape, np.uint8)
        mark_edges(key, edge)
        colour = np.empty((*key.shape, 3), np.float32)
        shade_image(self._scene, self._rays, R, p, key, depth, edge, colour)
        return Rendered(depth, self._instances(key), colour)


def camera_rays(camera: CameraModel) -> F64:
    """Directions (h + 1, w + 1, 2) float64: x, y at z = 1 of every whole raw pixel.

    nan where the lens model sees nothing; there the image stays black.
    """
    v, u = np.mgrid[0 : camera.height + 1, 0 : camera.width + 1].astype(np.float64)
    pixels = np.stack([u.ravel(), v.ravel()], axis=1)
    ideal = camera.normalise(camera.undistort_pixels(pixels))
    return np.ascontiguousarray(ideal.reshape(camera.height + 1, camera.width + 1, 2))


def _fill(rays: F64) -> F64:
    """The rays with every nan replaced by its nearest neighbour; edges look at those."""
    missing = np.isnan(rays[:, :, 0])
    if not missing.any():
        return rays
    v, u = distance_transform_edt(missing, return_distances=False, return_indices=True)
    return np.ascontiguousarray(rays[v, u])
