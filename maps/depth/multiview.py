# SPDX-License-Identifier: Apache-2.0
"""Depths from the views themselves: swept in each view, kept where other views agree."""

from collections.abc import Iterable, Iterator
from functools import partial
from secrets import token_hex
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edge.cameras.recording import open_recording
from edge.geometry import se3
from edge.geometry.camera import CameraModel
from edge.image.pyramid import half_size
from edge.runtime.progress import progress
from edge.types import F64, DepthSamples, Mat4, Pinhole
from maps.depth import kernels_multiview
from maps.depth.neighbours import choose_neighbours
from maps.depth.sweep import fine_pinhole
from maps.depth.swept_view import SweepContext, SweepTask, SweptView, sweep_view
from maps.describe import Description
from maps.fusion import Points
from maps.settings import BuildSettings
from maps.views import ViewSet
from maps.work_folder import WorkFolder, key_of, stamp
from maps.workers import Workers

_NEIGHBOURS = 4
_MAPS_KEPT = 24
# Views must agree to this part of the depth, and so many of them.
_TOLERANCE = 0.02
_AGREEING = 2
_MAX_SIGMA = 0.05  # of the inverse depth


class Neighbour(NamedTuple):
    """Another view's depth map, as a view looks it up."""

    T_other_view: Mat4
    pinhole: Pinhole
    swept: SweptView


class Depths:
    """The depth maps of a build's views: made when asked for, kept in its work folder."""

    def __init__(
        self,
        chosen: ViewSet,
        descriptions: list[Description],
        points: Points,
        work: WorkFolder,
    ) -> None:
        self._chosen, self._work = chosen, work
        self._context = SweepContext(tuple(chosen.roots), tuple(chosen.cameras), token_hex(8))
        poses = [view.T_map_cam for view in chosen.views]
        found = enumerate(choose_neighbours(points, poses, _NEIGHBOURS))
        self._around = {view: around for view, around in found if around is not None}
        self._tasks = self._make_tasks(descriptions)
        self._keys = self._make_keys()
        self._loaded: dict[int, SweptView] = {}

    @property
    def numbers(self) -> list[int]:
        """Views that have neighbours, and so depths."""
        return list(self._tasks)

    def neighbours(self, number: int) -> list[int]:
        """Views that tell the depths of the view `number`, the best first."""
        return self._around[number].views

    def sweep_all(self, workers: Workers) -> Iterator[SweptView]:
        """Make all depth maps, whoever does the work."""
        tasks, keys = list(self._tasks.values()), list(self._keys.values())
        return self._work.map(workers, partial(sweep_view, self._context), tasks, keys, SweptView)

    def swept(self, number: int) -> SweptView:
        """Depth map of the view `number`."""
        found = self._loaded.pop(number, None)
        if found is None:
            found = self._work.load(self._keys[number], SweptView)
        if found is None:
            found = sweep_view(self._context, self._tasks[number])
            self._work.keep(self._keys[number], found)
        self._loaded[number] = found
        while len(self._loaded) > _MAPS_KEPT:
            del self._loaded[next(iter(self._loaded))]
        return found

    def agreed(self, number: int) -> NDArray[np.bool_]:
        """Which depths (n,) of a view's map are known well, and to other views, too."""
        cameras, views = self._chosen.cameras, self._chosen.views
        T = views[number].T_map_cam
        others = []
        for other in self.neighbours(number):
            if other in self._tasks:
                pinhole = half_size(fine_pinhole(cameras[views[other].camera])[0])
                T_other_view = se3.inverse(views[other].T_map_cam) @ T
                others.append(Neighbour(T_other_view, pinhole, self.swept(other)))
        pinhole, _ = fine_pinhole(cameras[views[number].camera])
        return agreed(self.swept(number), pinhole, others)

    def _make_tasks(self, descriptions: list[Description]) -> dict[int, SweepTask]:
        tasks = {}
        for number, around in self._around.items():
            views = tuple(self._chosen.views[i] for i in (number, *around.views))
            pixels = descriptions[number].features.pixels
            tasks[number] = SweepTask(views, around.rho_range, pixels)
        return tasks

    def _make_keys(self) -> dict[int, str]:
        recordings = [open_recording(root) for root in self._context.roots]
        keys = {}
        for number, task in self._tasks.items():
            cameras = [self._context.cameras[view.camera] for view in task.views]
            images = [
                stamp(file)
                for view in task.views
                for file in recordings[view.sequence].files(view.image)[:1]
            ]
            poses = np.array([view.T_map_cam for view in task.views])
            keys[number] = key_of("swept", cameras, images, poses, task.rho_range, task.features)
        return keys


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
    depths = Depths(chosen, descriptions, points, work)
    numbers = depths.numbers
    for _ in progress(depths.sweep_all(workers), len(numbers), "depths"):
        pass
    found = list(descriptions)
    for number in progress(numbers, len(numbers), "agreement"):
        camera = chosen.cameras[chosen.views[number].camera]
        explained = points.feature[points.view == number]
        known = depths.agreed(number)
        found[number] = _described(
            descriptions[number], depths.swept(number), known, camera, explained, settings
        )
    return found


def agreed(swept: SweptView, pinhole: Pinhole, others: Iterable[Neighbour]) -> NDArray[np.bool_]:
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
    known: NDArray[np.bool_],
    camera: CameraModel,
    explained: NDArray[np.int32],
    settings: BuildSettings,
) -> Description:
    pinhole, halvings = fine_pinhole(camera)
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


def _numbers(pinhole: Pinhole) -> F64:
    return np.array([pinhole.fx, pinhole.fy, pinhole.cx, pinhole.cy])
