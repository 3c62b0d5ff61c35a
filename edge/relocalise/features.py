# SPDX-License-Identifier: Apache-2.0
"""ORB features, spread over the image, in the pixels of the ideal camera."""

from itertools import repeat
from typing import NamedTuple, Protocol

import cv2
import numpy as np

from edge.config.features import OrbConfig
from edge.geometry.camera import CameraModel
from edge.image.border import exposed
from edge.relocalise import kernels_features as kernels
from edge.types import F32, I32, U8

_PATCH_PX = 31  # side of the patch that a descriptor describes, at its own level
_MAX_PEAKS = 1 << 15  # a level; more is noise


class Features(NamedTuple):
    """Features of one image."""

    pixels: F32  # (n, 2) u, v; ideal, full size
    descriptors: U8  # (n, 32)
    octave: U8  # (n,) pyramid level; localised to about scale_factor ** octave pixels
    angle_rad: F32  # (n,)
    raw_pixels: F32  # (n, 2) in the image as it came, distorted


class Extractor(Protocol):
    """Finds features in images. One thread owns it."""

    def extract(self, image: U8, camera: CameraModel) -> Features:
        """Features of a grey image (h, w) uint8."""


class _Corners(NamedTuple):
    """Corners of one level, in its own pixels."""

    xs: I32
    ys: I32
    angle_rad: F32
    peaks: F32  # (n, 2) x, y between pixels


class OrbExtractor:
    """Finds FAST corners in equal shares and describes them as OpenCV's ORB does.

    The result depends on the image and the settings alone, not on threads. One thread
    owns an extractor.
    """

    def __init__(self, config: OrbConfig) -> None:
        self.config = config
        self._orb = cv2.ORB.create(
            nfeatures=config.max_features, nlevels=1, edgeThreshold=0, patchSize=_PATCH_PX
        )
        shares = config.scale_factor ** -np.arange(config.levels)
        self._quotas = np.round(config.max_features * shares / shares.sum()).astype(int)
        self._quotas[0] += config.max_features - self._quotas.sum()

    def extract(self, image: U8, camera: CameraModel) -> Features:
        """Features of a grey image (h, w) uint8; fewer than wanted where it shows fewer."""
        found = []
        missing = 0
        shown = exposed(image)
        # Coarse levels have few corners; what they cannot fill goes to the finer ones.
        for level, smaller in reversed(list(enumerate(self._levels(image)))):
            quota = int(self._quotas[level]) + missing
            whole = None if shown is None else _whole_patches(shown, smaller.shape)
            corners = self._corners(smaller, quota, whole)
            missing = quota - len(corners.xs)
            # A pixel of a smaller level covers an area: centres shift by half of it.
            ratio = np.array(image.shape[::-1], np.float32) / smaller.shape[::-1]
            found.append(self._described(smaller, level, corners, ratio.astype(np.float32)))
        found.reverse()
        raw, octave, angle_rad, descriptors = map(np.concatenate, zip(*found, strict=True))
        ideal = camera.undistort_pixels(raw).astype(np.float32)
        inside = np.flatnonzero(np.isfinite(ideal).all(axis=1))
        return Features(
            ideal[inside], descriptors[inside], octave[inside], angle_rad[inside], raw[inside]
        )

    def _described(
        self, image: U8, level: int, corners: _Corners, ratio: F32
    ) -> tuple[F32, U8, F32, U8]:
        """Centres in full size, octaves, angles and descriptors of one level's corners."""
        degrees: F32 = np.rad2deg(corners.angle_rad) % np.float32(360.0)
        keypoints = map(
            cv2.KeyPoint,
            corners.xs.tolist(),
            corners.ys.tolist(),
            repeat(_PATCH_PX),
            degrees.tolist(),
            repeat(0.0),
            repeat(0),
            range(len(degrees)),
        )
        described, descriptors = self._orb.compute(image, list(keypoints))
        if not described:
            descriptors = np.empty((0, 32), np.uint8)
        order = np.array([keypoint.class_id for keypoint in described], int)
        centres = ((corners.peaks[order] + 0.5) * ratio - 0.5).astype(np.float32)
        octave = np.full(len(order), level, np.uint8)
        return centres, octave, np.deg2rad(degrees[order]), np.asarray(descriptors, np.uint8)

    def _levels(self, image: U8) -> list[U8]:
        """The pyramid as OpenCV's ORB makes it."""
        levels = [image.view()]
        height, width = image.shape
        for level in range(1, self.config.levels):
            scale = self.config.scale_factor**level
            size = (round(width / scale), round(height / scale))
            if min(size) <= 2 * kernels.BORDER_PX:
                break
            levels.append(cv2.resize(levels[-1], size, interpolation=cv2.INTER_LINEAR_EXACT))
        for level_image in levels:
            level_image.flags.writeable = False  # a kernel compiles anew for each kind of array
        return levels

    def _corners(self, image: U8, quota: int, allowed: U8 | None) -> _Corners:
        threshold, cell = self.config.min_contrast_grey, self.config.cell_px
        height, width = image.shape
        columns, rows = -(-width // cell), -(-height // cell)
        scores = np.empty(image.shape, np.uint8)
        flat = scores.reshape(-1)
        kernels.score_corners(image.reshape(-1), height, width, flat)
        if allowed is not None:
            scores *= allowed
        xs, ys, cells = np.empty((3, _MAX_PEAKS), np.int32)
        histogram = np.zeros((columns * rows, 256), np.int32)
        eights = np.zeros(-(-flat.size // 8), np.uint64)
        kernels.mark_peaks(flat, height, width, np.uint8(threshold), eights.view(np.uint8))
        n = kernels.list_peaks(flat, width, eights, cell, columns, xs, ys, cells, histogram)
        by_rank = np.zeros((quota + 1, 256), np.int32)
        chosen = np.empty(quota, np.int32)
        m = kernels.share_out(scores, xs, ys, cells, n, histogram, quota, by_rank, chosen)
        xs, ys = xs[chosen[:m]], ys[chosen[:m]]
        angle, peaks = np.empty(m, np.float32), np.empty((m, 2), np.float32)
        kernels.orient(image, xs, ys, angle)
        kernels.refine(scores, xs, ys, peaks)
        return _Corners(xs, ys, angle, peaks)


def _whole_patches(shown: U8, shape: tuple[int, ...]) -> U8:
    """Where a level of `shape` (h, w) shows the whole patch about a pixel: (h, w) uint8, 0 or 1."""
    smaller = cv2.resize(shown, (shape[1], shape[0]), interpolation=cv2.INTER_NEAREST)
    return np.asarray(cv2.erode(smaller, np.ones((_PATCH_PX, _PATCH_PX), np.uint8)), np.uint8)
