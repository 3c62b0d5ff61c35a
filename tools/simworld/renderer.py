"""One exact image of a world from one place."""

from dataclasses import dataclass

import numpy as np

from edge.geometry.camera import CameraModel
from edge.types import F32, F64, I32
from tools.simworld.kernels_render import mark_edges, shade_image, trace_image
from tools.simworld.kernels_trace import FACES
from tools.simworld.noise import U8
from tools.simworld.packing import pack
from tools.simworld.world import World


@dataclass(frozen=True, slots=True, eq=False)
class Rendered:
    """What the camera sees; nothing of it is rounded yet but `bgr`."""

    colour: F32  # (h, w, 3) BGR, gamma coded, [0, 255] or above where it would burn out
    depth_m: F64  # (h, w) along the optical axis, 0 = nothing there
    ids: I32  # (h, w) instance, 0 = nothing there

    @property
    def bgr(self) -> U8:
        """The picture as 8 bits (h, w, 3)."""
        return np.clip(np.rint(self.colour), 0, 255).astype(np.uint8)


class Renderer:
    """Draws a world for one camera. Holds no state: threads may share it."""

    def __init__(self, world: World, camera: CameraModel) -> None:
        self.camera = camera
        self._scene = pack(world)
        self._rays = camera_rays(camera)
        self._instance = np.append(self._scene.instance, 0).astype(np.int32)

    def trace(self, T_world_cam: F64) -> Rendered:
        """Depth and ids alone; the colours stay black. Takes what `render` takes."""
        return self._render(T_world_cam, shaded=False)

    def render(self, T_world_cam: F64) -> Rendered:
        """The view from T_world_cam, (4, 4), or (h, 4, 4) with one pose for each row."""
        return self._render(T_world_cam, shaded=True)

    def _render(self, T_world_cam: F64, *, shaded: bool) -> Rendered:
        h, w = self.camera.height, self.camera.width
        rows = np.broadcast_to(T_world_cam, (h, 4, 4))
        R = np.ascontiguousarray(rows[:, :3, :3])
        p = np.ascontiguousarray(rows[:, :3, 3])
        key, depth = np.empty((h, w), np.int32), np.empty((h, w))
        trace_image(self._scene, self._rays, R, p, key, depth)
        colour = np.zeros((h, w, 3), np.float32)
        if shaded:
            edge = np.empty((h, w), np.uint8)
            mark_edges(key, edge)
            shade_image(self._scene, self._rays, R, p, key, depth, edge, colour)
        ids = self._instance[np.where(key >= 0, key // FACES, -1)]
        return Rendered(colour, depth, ids)


def camera_rays(camera: CameraModel) -> F64:
    """Directions (h + 1, w + 1, 2) float64: x, y at z = 1 of every whole raw pixel.

    nan where the lens model sees nothing; there the image stays black.
    """
    v, u = np.mgrid[0 : camera.height + 1, 0 : camera.width + 1].astype(np.float64)
    pixels = np.stack([u.ravel(), v.ravel()], axis=1)
    ideal = camera.normalise(camera.undistort_pixels(pixels))
    return np.ascontiguousarray(ideal.reshape(camera.height + 1, camera.width + 1, 2))
