# SPDX-License-Identifier: Apache-2.0
"""Undistorted, evenly bright float pyramids with gradients, from raw camera images."""

from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from edge.geometry.camera import CameraModel
from edge.image import kernels
from edge.image.border import eroded, exposed
from edge.image.noise import NoiseMeter, smoothing
from edge.image.shade import gain_against_shade
from edge.types import F32, F64, U8, Pinhole

# The residual pattern reaches 2 px, interpolation and its gradient 2 more.
MASK_MARGIN_PX = 4
STILL = np.zeros(3)
STILL.flags.writeable = False


@dataclass(frozen=True, slots=True, eq=False)
class Undistortion:
    """How raw images become those of the ideal pinhole. Never changed after it was made."""

    radial: float  # bend of the lens beside what its calibration says, as in CameraModel
    readout_s: float  # from the first row's exposure to the last one's; 0: a global shutter
    falloff: float  # log of how much darker the corners are than the centre
    maps: F32 | None  # as of `kernels.undistort`; None: the same pixel
    gain: F32 | None  # (h, w) of the first image made, against the fall-off; None: none
    masks: tuple[U8, ...]  # per level (h, w), 1 where a pattern may lie
    even_light: bool = False  # whether they are freed of soft shades


AS_IT_IS = Undistortion(radial=0.0, readout_s=0.0, falloff=0.0, maps=None, gain=None, masks=())


@dataclass(frozen=True, slots=True, eq=False)
class Pyramid:
    """Levels of one image, finest first, each (h, w, 3) float32 grey, dx, dy."""

    levels: tuple[F32, ...]
    undistortion: Undistortion = AS_IT_IS
    # (3,) angular rate that was taken off its rows [rad/s, camera axes]
    turning: F64 = field(default_factory=lambda: STILL)
    gain: F32 | None = None  # (h, w) of level 0, against soft shades

    @property
    def contrast_grey(self) -> float:
        """Standard deviation of the coarsest level: near zero where an image shows nothing."""
        coarsest = self.levels[-1][..., 0]
        if self.gain is None:
            return float(coarsest.std())
        step = 2 ** (len(self.levels) - 1)
        gain = self.gain[step // 2 :: step, step // 2 :: step]
        return float((coarsest / gain[: len(coarsest), : coarsest.shape[1]]).std())

    @property
    def as_seen(self) -> F32:
        """Level 0 (h, w) as bright as the camera saw it."""
        grey = self.levels[0][..., 0]
        return grey if self.gain is None else np.asarray(grey / self.gain, np.float32)

    def copy(self) -> "Pyramid":
        """The same in memory of its own."""
        levels = tuple(level.copy() for level in self.levels)
        return Pyramid(levels, self.undistortion, self.turning, self.gain)


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


def radius_2(pinhole: Pinhole, u: F64, v: F64) -> F64:
    """Squared distance from the optical axis, 1 at a corner; the fall-off grows with it."""
    corner = pinhole.width**2 + pinhole.height**2
    squares = (np.asarray(u) - pinhole.cx) ** 2 + (np.asarray(v) - pinhole.cy) ** 2
    return np.asarray(4.0 * squares / corner)


class PyramidBuilder:
    """Makes pyramids for one camera, in a few reused buffers.

    Owned by one thread, but for `undistortion`. A pyramid stays valid until
    `n_buffers` further ones were built, or longer by `keep`.
    """

    def __init__(self, camera: CameraModel, halvings: int, n_levels: int, n_buffers: int) -> None:
        """`halvings` full-size images are halved so often before level 0."""
        self._camera, self._halvings = camera, halvings
        sizes = [camera.pinhole]
        for _ in range(halvings + n_levels - 1):
            sizes.append(half_size(sizes[-1]))
        self.pinholes = sizes[halvings:]
        # The first image made is full-size or half; bilinear samples of a raw image at half
        # size are 2x2 means.
        self._first = sizes[min(halvings, 1)]
        self._used = self.undistortion(0.0, 0.0, 0.0)
        self._sources = [mask.copy() for mask in self._used.masks]
        self._exposed: tuple[U8, ...] = ()
        self.masks = [mask.copy() for mask in self._used.masks]
        p = self._first
        self._intrinsics = np.array([p.fx, p.fy, p.cx, p.cy], np.float32)
        self._rows = np.empty(camera.width * camera.height + 3 * p.width, np.float32)
        # Sizes that are passed on the way down to level 0, when it is more than one halving.
        self._scratch = [np.zeros((p.height, p.width, 3), np.float32) for p in sizes[1:halvings]]
        self._noise = NoiseMeter()
        self._smooth_rows = np.empty((3, self.pinholes[0].width), np.float32)
        self._buffers = [self._allocate() for _ in range(n_buffers)]
        self._last, self._kept = 0, -1  # of the buffers; -1: none

    @property
    def used(self) -> Undistortion:
        """What further pyramids are made with."""
        return self._used

    @property
    def readout_s(self) -> float:
        """From the first row's exposure to the last one's, as far as it is known."""
        return self._used.readout_s

    @property
    def scale(self) -> float:
        """Full-size pixels per pixel of level 0."""
        return float(2**self._halvings)

    def undistortion(self, radial: float, readout_s: float, falloff: float) -> Undistortion:
        """The maps for another bend and fall-off of the lens; any thread may ask."""
        maps: F32 | None = None
        mask: U8 = np.ones((self._first.height, self._first.width), np.uint8)
        if self._camera.distortion_model != "none" or radial != 0.0 or readout_s != 0.0:
            map_x, map_y, mask = self._camera.undistortion_maps(self._first, radial=radial)
            maps = np.ascontiguousarray(np.stack((map_x, map_y), axis=2))
        for _ in range(1, self._halvings):
            mask = _halve_mask(mask)
        masks = self._eroded(mask)
        gain: F32 | None = None
        if falloff != 0.0:
            rows, columns = np.mgrid[: self._first.height, : self._first.width]
            share = radius_2(self._first, columns, rows)
            gain = np.exp(falloff * share).astype(np.float32)
        return Undistortion(radial, readout_s, falloff, maps, gain, masks)

    def use(self, undistortion: Undistortion) -> None:
        """Make further pyramids with it; `masks` shrink in place where it has no source.

        They never grow by it, since older pyramids are still about.
        """
        self._used = undistortion
        for mask, other in zip(self._sources, undistortion.masks, strict=True):
            np.minimum(mask, other, out=mask)
        self._update_masks()

    def leave_out_frame(self, pyramid: Pyramid) -> None:
        """Take the unexposed frame around `pyramid`'s image out of `masks`, in place.

        Until the next call; for a start, since what is dark now may be lit later.
        """
        shown = exposed(pyramid.as_seen)
        self._exposed = () if shown is None else self._eroded(shown)
        self._update_masks()

    def _update_masks(self) -> None:
        for level, (mask, source) in enumerate(zip(self.masks, self._sources, strict=True)):
            if self._exposed:
                np.minimum(source, self._exposed[level], out=mask)
            else:
                mask[:] = source

    def _eroded(self, mask: U8) -> tuple[U8, ...]:
        """A mask of level 0 on all levels, each less its margin."""
        masks: list[U8] = []
        for _ in self.pinholes:
            masks.append(eroded(mask, MASK_MARGIN_PX))
            mask = _halve_mask(mask)
        return tuple(masks)

    def keep(self) -> None:
        """Let the last pyramid stay valid until this is asked for another one."""
        self._kept = self._last

    def is_like(self, pyramid: Pyramid, turning: F64) -> bool:
        """Whether `build` would make the same levels of the image of a pyramid."""
        used, other = self._used, pyramid.undistortion
        if used.even_light or other.even_light:  # by masks, which are each builder's own
            return False
        same = (used.radial, used.readout_s, used.falloff) == (
            other.radial,
            other.readout_s,
            other.falloff,
        )
        return same and (used.readout_s == 0.0 or np.array_equal(turning, pyramid.turning))

    def build(self, image: U8, turning: F64 = STILL, *, instead: bool = False) -> Pyramid:
        """Pyramid of a raw `image` (H, W) uint8 of this camera.

        `turning` (3,) is the camera's angular rate [rad/s, its own axes] meanwhile. With
        `instead` it takes the place of the last one, which is void then.
        """
        used = self._used
        if not instead:
            step = 1 + ((self._last + 1) % len(self._buffers) == self._kept)
            self._last = (self._last + step) % len(self._buffers)
        levels = self._buffers[self._last]
        passed = [*self._scratch, levels[0]]
        if used.maps is not None:
            turn = (used.readout_s * turning).astype(np.float32)
            kernels.undistort(image, used.maps, turn, self._intrinsics, self._rows, passed[0])
        elif self._halvings == 0:
            kernels.copy_grey(image, passed[0])
        else:
            kernels.halve_grey(image, passed[0])
        if used.gain is not None:
            kernels.brighten(passed[0], used.gain)
        for finer, coarser in pairwise(passed):
            kernels.halve_level(finer, coarser)
        gain = gain_against_shade(levels[0][..., 0], self.masks[0]) if used.even_light else None
        if gain is not None:
            kernels.brighten(levels[0], gain)
        # Each halving has halved it.
        share = smoothing(self._noise.sigma_grey(image) / self.scale)
        if share > 0.0:
            kernels.smooth(levels[0], np.float32(share), self._smooth_rows)
        kernels.differentiate(levels[0])
        for finer, coarser in pairwise(levels):
            kernels.halve_level(finer, coarser)
            kernels.differentiate(coarser)
        return Pyramid(levels, used, turning, gain)

    def _allocate(self) -> tuple[F32, ...]:
        return tuple(np.zeros((p.height, p.width, 3), np.float32) for p in self.pinholes)


def _halve_mask(mask: U8) -> U8:
    out = np.empty((mask.shape[0] // 2, mask.shape[1] // 2), np.uint8)
    kernels.halve_mask(mask, out)
    return out
