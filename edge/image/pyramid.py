"""Undistorted float pyramids with gradients, from raw camera images."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from edge.geometry.camera import CameraModel
from edge.image import kernels
from edge.types import F32, U8, Pinhole

# The residual pattern reaches 2 px, interpolation and its gradient 2 more.
MASK_MARGIN_PX = 4


@dataclass(frozen=True, slots=True, eq=False)
class Pyramid:
    """Levels of one image, finest first, each (h, w, 3) float32 grey, dx, dy.

    `grey` is the undistorted full-size image (H, W) uint8 that they come from.
    """

    grey: U8
    levels: tuple[F32, ...]

    def copy(self) -> "Pyramid":
        """The same in memory of its own."""
        return Pyramid(self.grey.copy(), tuple(level.copy() for level in self.levels))


def half_size(pinhole: Pinhole) -> Pinhole:
    """Intrinsics after averaging 2x2 pixels; odd last rows and columns are dropped."""
    return Pinhole(
        pinhole.width // 2,
        pinhole.height // 2,
        pinhole.fx / 2,
        pinhole.fy / 2,
        (pinhole.cx + 0.5) / 2 - 0.5,
        (pinhole.cy + 0.5) / 2 - 0.5,
    )


class PyramidBuilder:
    """Makes pyramids for one camera, in a few reused buffers.

    Owned by one thread. A pyramid stays valid until `n_buffers` further ones
    were built; who needs it longer copies it.
    """

    def __init__(self, camera: CameraModel, halvings: int, n_levels: int, n_buffers: int) -> None:
        """`halvings` full-size images are halved so often before level 0."""
        self._full = camera.pinhole
        self._maps: tuple[F32, F32] | None = None
        mask: U8 = np.ones((self._full.height, self._full.width), np.uint8)
        if camera.distortion_model != "none":
            map_x, map_y, mask = camera.undistortion_maps()
            self._maps = (map_x, map_y)
        pinhole = self._full
        for _ in range(halvings):
            mask, pinhole = _halve_mask(mask), half_size(pinhole)
        self._halvings = halvings
        self.pinholes: list[Pinhole] = []
        self.masks: list[U8] = []
        for _ in range(n_levels):
            eroded = np.empty_like(mask)
            kernels.erode_mask(mask, MASK_MARGIN_PX, eroded)
            self.pinholes.append(pinhole)
            self.masks.append(eroded)
            mask, pinhole = _halve_mask(mask), half_size(pinhole)
        # Sizes that are passed on the way down to level 0, when it is more than one halving.
        self._scratch = [
            np.zeros((self._full.height >> k, self._full.width >> k, 3), np.float32)
            for k in range(1, halvings)
        ]
        self._buffers = [self._allocate() for _ in range(n_buffers)]
        self._next = 0

    @property
    def scale(self) -> float:
        """Full-size pixels per pixel of level 0."""
        return float(2**self._halvings)

    def build(self, image: U8) -> Pyramid:
        """Pyramid of a raw `image` (H, W) uint8 of this camera."""
        pyramid = self._buffers[self._next]
        self._next = (self._next + 1) % len(self._buffers)
        if self._maps is None:
            pyramid.grey[:] = image
        else:
            kernels.undistort(image, self._maps[0], self._maps[1], pyramid.grey)
        if self._halvings == 0:
            kernels.copy_grey(pyramid.grey, pyramid.levels[0])
        else:
            passed = [*self._scratch, pyramid.levels[0]]
            kernels.halve_grey(pyramid.grey, passed[0])
            for finer, coarser in pairwise(passed):
                kernels.halve_level(finer, coarser)
        kernels.differentiate(pyramid.levels[0])
        for finer, coarser in pairwise(pyramid.levels):
            kernels.halve_level(finer, coarser)
            kernels.differentiate(coarser)
        return pyramid

    def _allocate(self) -> Pyramid:
        grey = np.zeros((self._full.height, self._full.width), np.uint8)
        shapes = [(p.height, p.width, 3) for p in self.pinholes]
        return Pyramid(grey, tuple(np.zeros(shape, np.float32) for shape in shapes))


def _halve_mask(mask: U8) -> U8:
    out = np.empty((mask.shape[0] // 2, mask.shape[1] // 2), np.uint8)
    kernels.halve_mask(mask, out)
    return out
