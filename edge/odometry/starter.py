# SPDX-License-Identifier: Apache-2.0
"""Waits for enough parallax, then gives poses for the first window, or nothing.

Corners are followed from a reference frame; whenever they moved far enough, a
bundle adjustment over several frames says how certain their depths would be.
Only the certainty of the depths decides (it covers forward motion too, where
baseline over depth says little). Standing still and pure rotation never do.
"""

import logging
from dataclasses import dataclass

import cv2
import numpy as np

from edge.config.odometry import OdometryConfig
from edge.odometry.corner_flow import flatten, followed
from edge.odometry.structure import Structure, reconstruct, rival_residual
from edge.types import F32, F64, U8, Frame, Mat4, Pinhole

log = logging.getLogger(__name__)

# Frames kept between the reference and now; every second one goes when there are more.
MAX_FRAMES = 12
# Frames of the bundle adjustment: the newest and some before.
MAX_ADJUSTED = 6
# Motion of corners [share of width + height] below which a try is pointless.
MIN_MOTION_SHARE = 0.004
MAX_RESIDUAL_PX = 0.9
# Any other interpretation must fit worse by this; true starts on hand-held video gave 1.5 and
# more, false ones 1.1 to 1.3.
MIN_RIVAL_RATIO = 1.4
# The inliers must cover this share of a 4x4 grid laid over all corners of the reference.
MIN_COVERAGE = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class Start:
    """Frames of the first window with their poses, the reference first."""

    frames: tuple[Frame, ...]
    T_cam_reference: tuple[Mat4, ...]
    pixels: F32  # (n, 2) corners of the reference, px of the tracked image; none if by edges
    inverse_depth: F32  # (n,)
    max_relative_sigma: float
    # (6 f, 6 f) of twists on the left of all T_cam_reference, where images alone say too little
    information: F64 | None = None


@dataclass(slots=True, eq=False)
class _Tracked:
    frame: Frame
    pixels: F32  # (n, 2) where the reference's corners are, NaN once lost


class Starter:
    """Owned by the tracking thread. `step` takes undistorted grey images at level 0's size."""

    def __init__(self, pinhole: Pinhole, mask: U8, config: OdometryConfig) -> None:
        self._pinhole, self._mask, self._config = pinhole, mask, config
        self._size = pinhole.width + pinhole.height
        self.reset()

    def reset(self) -> None:
        """Forget the reference."""
        self._tracked: list[_Tracked] = []
        self._previous: U8 | None = None
        self._age = 0

    @property
    def has_reference(self) -> bool:
        """Whether a reference frame with enough corners is held."""
        return bool(self._tracked)

    def step(self, frame: Frame, grey: U8) -> Start | None:
        """Follow the corners into `grey` (h, w); the start, once it is certain enough."""
        flat = flatten(grey)
        if self._previous is None or not self._follow(frame, flat):
            self._begin(frame, grey, flat)
            return None
        self._previous = flat
        self._age += 1
        start = self._attempt()
        if start is None and self._age > self._config.start_max_age_frames:
            self._begin(frame, grey, flat)
        return start

    def _begin(self, frame: Frame, grey: U8, flat: U8) -> None:
        self.reset()
        corners = cv2.goodFeaturesToTrack(
            grey,
            self._config.start_corners,
            0.01,
            max(5.0, 0.014 * self._size),
            mask=self._mask,
        )
        if corners is None or len(corners) < self._config.start_min_tracks:
            return
        self._tracked = [_Tracked(frame, np.ascontiguousarray(corners.reshape(-1, 2)))]
        self._previous = flat

    def _follow(self, frame: Frame, flat: U8) -> bool:
        """Track the living corners one frame on; False when too few are left."""
        assert self._previous is not None
        pixels = followed(self._previous, flat, self._tracked[-1].pixels, self._velocity())
        if np.count_nonzero(np.isfinite(pixels[:, 0])) < self._config.start_min_tracks:
            return False
        self._tracked.append(_Tracked(frame, pixels))
        if len(self._tracked) > MAX_FRAMES:
            # The reference stays; the newest two stay, for the velocity.
            del self._tracked[1:-2:2]
        return True

    def _velocity(self) -> F32:
        """Motion of each corner over the last frame, where the last two are neighbours."""
        if len(self._tracked) < 2:
            return np.zeros_like(self._tracked[-1].pixels)
        a, b = self._tracked[-2], self._tracked[-1]
        if b.frame.index - a.frame.index > 2:
            return np.zeros_like(b.pixels)
        moved = b.pixels - a.pixels
        return np.where(np.isfinite(moved), moved, np.float32(0.0)).astype(np.float32)

    def _attempt(self) -> Start | None:
        reference, last, p = self._tracked[0], self._tracked[-1], self._pinhole
        alive = np.isfinite(last.pixels[:, 0])
        moved = np.linalg.norm(last.pixels[alive] - reference.pixels[alive], axis=1)
        if np.median(moved) < MIN_MOTION_SHARE * self._size:
            return None
        chosen = self._chosen()
        observed = np.stack([self._normalise(t.pixels[alive]) for t in chosen])
        seen = np.isfinite(observed[..., 0]).astype(np.uint8)
        rays, focal_px = self._normalise(reference.pixels[alive]), 0.5 * (p.fx + p.fy)
        observed = np.where(np.isfinite(observed), observed, 0.0)
        structure = reconstruct(rays, observed, seen, focal_px)
        if structure is None or not self._is_certain(structure, reference.pixels[alive]):
            return None
        rival_px = rival_residual(structure, rays, observed, seen, focal_px)
        if rival_px < MIN_RIVAL_RATIO * structure.residual_px:
            log.debug("start refused rival_px=%.3f", rival_px)
            return None
        inlier = structure.inlier > 0
        return Start(
            frames=(reference.frame, *(t.frame for t in chosen)),
            T_cam_reference=(np.eye(4), *structure.T_frame_reference),
            pixels=reference.pixels[alive][inlier],
            inverse_depth=structure.inverse_depth[inlier].astype(np.float32),
            max_relative_sigma=float(np.median(structure.relative_sigma[inlier])),
        )

    def _chosen(self) -> list[_Tracked]:
        """The newest frame and an even choice of those before, in order."""
        others = self._tracked[1:]
        picks = np.unique(np.linspace(0, len(others) - 1, MAX_ADJUSTED).round().astype(int))
        return [others[i] for i in picks]

    def _is_certain(self, structure: Structure, pixels: F32) -> bool:
        inlier = structure.inlier > 0
        share = np.count_nonzero(inlier) / len(inlier)
        sigma = float(np.median(structure.relative_sigma[inlier]))
        covered = _grid_cells(pixels[inlier], pixels) / max(_grid_cells(pixels, pixels), 1)
        certain = (
            np.count_nonzero(inlier) >= 0.7 * self._config.start_min_tracks
            and share > 0.6
            and structure.residual_px < MAX_RESIDUAL_PX
            and covered >= MIN_COVERAGE
            and sigma < self._config.start_max_depth_sigma
        )
        log.debug(
            "start attempt inliers=%.2f residual_px=%.3f sigma=%.3f covered=%.2f certain=%s",
            share,
            structure.residual_px,
            sigma,
            covered,
            certain,
        )
        return bool(certain)

    def _normalise(self, pixels: F32) -> F64:
        p = self._pinhole
        return (pixels.astype(np.float64) - [p.cx, p.cy]) / [p.fx, p.fy]


def _grid_cells(pixels: F32, extent: F32) -> int:
    """How many cells of a 4x4 grid over `extent` hold one of `pixels`."""
    low, high = extent.min(axis=0), extent.max(axis=0) + 1e-3
    cells = np.floor(4.0 * (pixels - low) / (high - low)).astype(int)
    return len({(int(a), int(b)) for a, b in cells})


def brightness_against(first: F32, now: F32, mask: U8) -> F64:
    """Affine brightness (2,) a, b from the statistics of whole images: enough to begin with.

    Both are a pyramid's level (h, w, 3) of the same size, `mask` (h, w) 1 where they count.
    """
    before, after = first[..., 0][mask > 0], now[..., 0][mask > 0]
    a = float(np.log(max(float(after.std()), 1.0) / max(float(before.std()), 1.0)))
    return np.array([a, float(after.mean()) - float(np.exp(a)) * float(before.mean())])
