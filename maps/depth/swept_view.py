# SPDX-License-Identifier: Apache-2.0
"""The depth map of one view as a piece of work: what it needs, and what comes back."""

import threading
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edge.cameras.recording import Recording, open_recording
from edge.config.odometry import OdometryConfig
from edge.errors import RecordingError
from edge.geometry import se3
from edge.geometry.camera import CameraModel
from edge.types import F32, I32
from maps.depth.sweep import FineImage, fine_image, gradient_pixels, sweep
from maps.views import View

_IMAGES_KEPT = 8  # undistorted, of each thread


class SweepTask(NamedTuple):
    """One view and the neighbours that tell its depths."""

    views: tuple[View, ...]  # the view, then its neighbours
    rho_range: tuple[float, float]
    features: F32  # (n, 2) ideal full-size pixels of its features


class SweptView(NamedTuple):
    """What one view knows of depth; those of the features come last."""

    pixels: NDArray[np.uint16]  # (n, 2) in the fine image
    rho: F32  # (n,) inverse depth, 0 where unknown
    sigma: F32  # (n,)
    coarse: NDArray[np.float16]  # (h, w) inverse depth of half the fine image over its largest
    largest: F32  # (1,)


class SweepContext(NamedTuple):
    """What all views have in common."""

    roots: tuple[Path, ...]
    cameras: tuple[CameraModel, ...]
    build: str  # drawn anew by each, as a lasting worker may remember older images


class _Images(threading.local):
    """Undistorted images of a thread, the last used ones."""

    def __init__(self) -> None:
        self._forget("")

    def _forget(self, build: str) -> None:
        self._build = build
        self._recordings: dict[Path, Recording] = {}
        self._kept: dict[tuple[object, ...], FineImage] = {}

    def fine(self, context: SweepContext, view: View) -> FineImage:
        if context.build != self._build:
            self._forget(context.build)
        root, camera = context.roots[view.sequence], context.cameras[view.camera]
        key = (root, camera, view.image)
        image = self._kept.pop(key, None)
        if image is None:
            if root not in self._recordings:
                self._recordings[root] = open_recording(root)
            raw = self._recordings[root].image(view.image)
            if raw is None:
                raise RecordingError(f"{root}: image {view.image} cannot be read any more")
            image = fine_image(raw, camera)
        self._kept[key] = image
        while len(self._kept) > _IMAGES_KEPT:
            del self._kept[next(iter(self._kept))]
        return image


_images = _Images()


def sweep_view(context: SweepContext, task: SweepTask) -> SweptView:
    """Sweep one view; runs wherever the work is done."""
    own, *others = (_images.fine(context, view) for view in task.views)
    strong = gradient_pixels(own, OdometryConfig())
    features = _fine_pixels(task.features, own)
    pixels = np.concatenate([strong, features])
    T = [se3.inverse(view.T_map_cam) @ task.views[0].T_map_cam for view in task.views[1:]]
    found = sweep(own, others, T, task.rho_range, pixels)
    largest = np.array([max(float(found.coarse.max()), 1e-9)], np.float32)
    return SweptView(
        pixels.astype(np.uint16),
        found.rho,
        found.sigma,
        (found.coarse / largest).astype(np.float16),
        largest,
    )


def _fine_pixels(features: F32, fine: FineImage) -> I32:
    """Nearest pixels (n, 2) of the fine image; at its border where features lie too near to it."""
    pixels = np.round((features + 0.5) / 2**fine.halvings - 0.5).astype(np.int32)
    limits = (fine.pinhole.width - 4, fine.pinhole.height - 4)
    clipped: I32 = np.clip(pixels, 3, limits).astype(np.int32)
    return clipped
