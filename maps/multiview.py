# SPDX-License-Identifier: Apache-2.0
"""Depths from the views themselves: swept in each view, kept where other views agree."""

import threading
from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache, partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edge.cameras.recording import Recording, open_recording
from edge.config.odometry import OdometryConfig
from edge.errors import RecordingError
from edge.geometry import se3
from edge.geometry.camera import CameraModel
from edge.image.pyramid import half_size
from edge.types import F32, F64, DepthSamples, Mat4, Pinhole
from maps import kernels_multiview
from maps.describe import Description
from maps.fusion import Points
from maps.neighbours import choose_neighbours
from maps.progress import progress
from maps.settings import BuildSettings
from maps.sweep import FineImage, fine_image, fine_pinhole, gradient_pixels, sweep
from maps.views import View, ViewSet
from maps.work_folder import WorkFolder, key_of
from maps.workers import Workers

_NEIGHBOURS = 4
_IMAGES_KEPT = 8  # undistorted, in each process
_MAPS_KEPT = 24
# Views must agree to this part of the depth, and so many of them.
_TOLERANCE = 0.02
_AGREEING = 2
_MAX_SIGMA = 0.05  # of the inverse depth

Pixels = NDArray[np.int32]


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


class Neighbour(NamedTuple):
    """Another view's depth map, as a view looks it up."""

    T_other_view: Mat4
    pinhole: Pinhole
    swept: SweptView


class _Images(threading.local):
    """Undistorted images of a thread, the last used ones."""

    def __init__(self) -> None:
        self._recordings: dict[Path, Recording] = {}
        self._kept: dict[tuple[object, ...], FineImage] = {}

    def fine(self, context: SweepContext, view: View) -> FineImage:
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


def with_multiview_depth(
    chosen: ViewSet,
    descriptions: list[Description],
    points: Points,
    settings: BuildSettings,
    workers: Workers,
    work: WorkFolder,
) -> list[Description]:
    """Descriptions with depth samples, and with depths of the features that no point explains.

    A feature of a point has been measured in the same images already: its depth would count twice.
    """
    tasks = _tasks(chosen, descriptions, points)
    context = SweepContext(tuple(chosen.roots), tuple(chosen.cameras))
    function = partial(sweep_view, context)
    numbers = [i for i, task in enumerate(tasks) if task is not None]
    given = [task for task in tasks if task is not None]
    keys = [_key(context, task) for task in given]
    swept = work.map(workers, function, given, keys, SweptView)
    for _ in progress(swept, len(given), "depths"):
        pass
    stored = dict(zip(numbers, zip(given, keys, strict=True), strict=True))

    @lru_cache(maxsize=_MAPS_KEPT)
    def load(number: int) -> SweptView:
        task, key = stored[number]
        return work.load(key, SweptView) or function(task)

    found = []
    rows = {_place(view): i for i, view in enumerate(chosen.views)}
    for number in progress(range(len(tasks)), len(tasks), "agreement"):
        described, task = descriptions[number], tasks[number]
        if task is not None:
            others = [rows[_place(view)] for view in task.views[1:]]
            others = [other for other in others if other in stored]
            seen = _neighbours(chosen, number, others, load)
            camera = chosen.cameras[chosen.views[number].camera]
            explained = points.feature[points.view == number]
            described = _described(described, load(number), camera, seen, explained, settings)
        found.append(described)
    return found


def _place(view: View) -> tuple[int, int]:
    return view.sequence, view.image


def _tasks(
    chosen: ViewSet, descriptions: list[Description], points: Points
) -> list[SweepTask | None]:
    poses = [view.T_map_cam for view in chosen.views]
    tasks: list[SweepTask | None] = []
    for number, around in enumerate(choose_neighbours(points, poses, _NEIGHBOURS)):
        if around is None:
            tasks.append(None)
            continue
        views = tuple(chosen.views[i] for i in (number, *around.views))
        tasks.append(SweepTask(views, around.rho_range, descriptions[number].features.pixels))
    return tasks


def _key(context: SweepContext, task: SweepTask) -> str:
    places = [(context.roots[v.sequence], v.image, context.cameras[v.camera]) for v in task.views]
    poses = np.array([view.T_map_cam for view in task.views])
    return key_of("swept", places, poses, task.rho_range, task.features)


def _neighbours(
    chosen: ViewSet, number: int, others: Sequence[int], load: Callable[[int], SweptView]
) -> Iterator[Neighbour]:
    T = chosen.views[number].T_map_cam
    for other in others:
        view = chosen.views[other]
        pinhole = half_size(fine_pinhole(chosen.cameras[view.camera])[0])
        yield Neighbour(se3.inverse(view.T_map_cam) @ T, pinhole, load(other))


def agreed(swept: SweptView, pinhole: Pinhole, others: Iterator[Neighbour]) -> NDArray[np.bool_]:
    """Which of a view's depths (n,) are known well, and to other views, too."""
    pixels = swept.pixels.astype(np.int32)
    agreeing, visible = np.zeros((2, len(pixels)), np.uint8)
    for other in others:
        depths = other.swept.coarse.astype(np.float32) * other.swept.largest
        kernels_multiview.agree(
            pixels, swept.rho, _numbers(pinhole), other.T_other_view, _numbers(other.pinhole),
            depths, _TOLERANCE, agreeing, visible,
        )  # fmt: skip
    sure = (agreeing >= _AGREEING) & (2 * agreeing >= visible)
    known: NDArray[np.bool_] = sure & (swept.rho > 0.0) & (swept.sigma < _MAX_SIGMA * swept.rho)
    return known


def _described(
    described: Description,
    swept: SweptView,
    camera: CameraModel,
    others: Iterator[Neighbour],
    explained: NDArray[np.int32],
    settings: BuildSettings,
) -> Description:
    pinhole, halvings = fine_pinhole(camera)
    known = agreed(swept, pinhole, others)
    n = len(described.features.pixels)
    strong = len(known) - n
    alone = known[strong:]
    alone[explained] = False
    depth, sigma = np.zeros(n), np.zeros(n)
    rho = swept.rho[strong:][alone].astype(np.float64)
    depth[alone] = 1.0 / rho
    sigma[alone] = swept.sigma[strong:][alone] / rho**2
    rows = np.flatnonzero(known[:strong])
    rows = rows[_spread(swept, rows, pinhole, settings.max_depth_samples)]
    full = (swept.pixels[rows].astype(np.float32) + 0.5) * 2**halvings - 0.5
    samples = DepthSamples(full, swept.rho[rows], swept.sigma[rows])
    return described._replace(depth=depth, depth_sigma=sigma, samples=samples)


def _spread(
    swept: SweptView, rows: NDArray[np.int64], pinhole: Pinhole, count: int
) -> NDArray[np.int64]:
    """Of each cell of a grid the surest of `rows`; at most `count`."""
    if count == 0:
        return rows[:0]
    cell = max(4, int(np.ceil(np.sqrt(pinhole.width * pinhole.height / count))))
    u, v = (swept.pixels[rows] // cell).astype(np.int64).T
    place = v * (pinhole.width // cell + 1) + u
    order = np.lexsort((swept.sigma[rows] / swept.rho[rows], place))
    first = np.flatnonzero(np.diff(place[order], prepend=-1))
    chosen: NDArray[np.int64] = np.sort(order[first])[:count]
    return chosen


def _fine_pixels(features: F32, fine: FineImage) -> Pixels:
    """Nearest pixels (n, 2) of the fine image; at its border where features lie too near to it."""
    pixels = np.round((features + 0.5) / 2**fine.halvings - 0.5).astype(np.int32)
    limits = (fine.pinhole.width - 4, fine.pinhole.height - 4)
    clipped: Pixels = np.clip(pixels, 3, limits).astype(np.int32)
    return clipped


def _numbers(pinhole: Pinhole) -> F64:
    return np.array([pinhole.fx, pinhole.fy, pinhole.cx, pinhole.cy])
