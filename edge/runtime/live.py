# SPDX-License-Identifier: Apache-2.0
"""The live pipeline, and what can be exchanged in it between two frames."""

import time
from dataclasses import dataclass
from functools import partial
from itertools import count
from pathlib import Path
from typing import NamedTuple

import msgspec

from edge.config import Config
from edge.config.odometry import OdometryConfig
from edge.geometry.camera import CameraModel
from edge.odometry.odometry import Odometry
from edge.outputs.report import FrameReport
from edge.outputs.serial_output import make_stream
from edge.outputs.serial_stream import SerialStream
from edge.registration.registration import Registration
from edge.runtime.finding import make_finder
from edge.runtime.keyframe_worker import KeyframeTimes, ThreadedKeyframeWorker
from edge.runtime.pipeline import Pipeline
from edge.runtime.priority import settle
from edge.runtime.search import NoSearch, Search, ThreadedSearch
from edge.tiles.reader import Map, open_map
from edge.types import Frame, Mat4, Mat6, Moving

_CLOCK = time.monotonic_ns


@dataclass(frozen=True, slots=True, eq=False)
class OpenedMap:
    """A map that is ready to be looked in, with a relocaliser of its own beside the running one."""

    map: Map
    search: Search
    camera: CameraModel  # by which the map reads our images
    serial_stream: SerialStream | None = None  # where there is a serial line

    @property
    def name(self) -> str:
        """What messages call the map: the name of its folder."""
        return self.map.folder.resolve().name


class Tracking(NamedTuple):
    """An odometry with what works for it."""

    odometry: Odometry
    worker: ThreadedKeyframeWorker
    times: KeyframeTimes


class LiveStages:
    """Tracking in the owner's thread, keyframe work and relocaliser each in its own.

    Owned by the tracking thread, but for `open_map`, which any thread may call.
    """

    def __init__(self, config: Config, camera: CameraModel, opened: OpenedMap | None) -> None:
        self._config = config
        self._camera = camera if opened is None else opened.camera
        self._odometry_config = config.odometry
        self._search = _search(config, camera, None) if opened is None else opened.search
        self.map = None if opened is None else opened.map
        self._odom_ids = count(1)
        tracking = self._make_tracking(self._camera)
        self._worker = tracking.worker
        self._pipeline = Pipeline(
            tracking.odometry, self._registration(), self._search, config.runtime, _CLOCK,
            tracking.times, self._odom_ids,
        )  # fmt: skip

    def step(self, frame: Frame) -> FrameReport:
        """Everything that `frame` gave.

        TileError before anything is done with it, once the search finds the map damaged.
        """
        return self._pipeline.step(frame)

    def use_map(self, opened: OpenedMap) -> Search:
        """Look for frames in another map from now on; return the old search, to be closed.

        Closing waits for the query under way, so it is best left to another thread.
        """
        self._search, self.map = opened.search, opened.map
        if opened.camera != self._camera:
            self._camera = opened.camera
            self._restart_odometry()
        return self._pipeline.replace_map(opened.search, self._registration())

    def drop_map(self) -> None:
        """Go on without a map, and so without poses in it; the odometry goes on."""
        self._search.close()
        self._search, self.map = NoSearch(), None
        self._pipeline.replace_map(self._search, self._registration())

    def reset(self) -> None:
        """Forget where the camera is and begin anew, in a new odometry frame."""
        self._restart_odometry()
        self._pipeline.replace_map(self._search, self._registration())

    def set_start(self, T_map_cam: Mat4, covariance: Mat6) -> None:
        """Forget where the camera was in the map, and look for it near `T_map_cam` first."""
        self._pipeline.replace_map(self._search, self._registration())
        self._pipeline.set_start(T_map_cam, covariance)

    def use_preset(self, config: OdometryConfig) -> None:
        """Track with other settings, in a new odometry frame."""
        if config != self._odometry_config:
            self._odometry_config = config
            self._restart_odometry()

    def hide(self, moving: Moving) -> None:
        """Let the odometry measure nothing by what moved in a recent frame."""
        self._pipeline.hide(moving)

    def stretch_queries(self, factor: int) -> None:
        """Ask the relocaliser only every `factor` times as many frames as configured."""
        self._pipeline.stretch_queries(factor)

    def close(self) -> None:
        """End the threads."""
        self._worker.close()
        self._search.close()

    def _make_tracking(self, camera: CameraModel) -> Tracking:
        times = KeyframeTimes(_CLOCK, inline=False)
        threads = self._config.runtime.threads
        place = partial(settle, threads.keyframes_cpus, threads.keyframes_nice)
        worker = ThreadedKeyframeWorker(times, place)
        odometry = Odometry(camera, self._odometry_config, worker, _CLOCK)
        return Tracking(odometry, worker, times)

    def _restart_odometry(self) -> None:
        tracking = self._make_tracking(self._camera)
        self._pipeline.replace_odometry(tracking.odometry, tracking.times)
        self._worker.abandon()
        self._worker = tracking.worker

    def _registration(self) -> Registration:
        config = msgspec.structs.replace(self._config.registration, keep_trajectory=False)
        return Registration(config)


def open_beside(folder: Path, config: Config, camera: CameraModel) -> OpenedMap:
    """Open a map with all that depends on it; EdgeError says why it cannot be used."""
    map_ = open_map(folder, resident_bytes=config.map.resident_bytes)
    serial = config.outputs.serial
    stream = None
    if serial.device:
        manifest = map_.manifest
        stream = make_stream(
            serial,
            metric=manifest.metric,
            T_local_map=manifest.T_local_map,
            map_name=str(folder),
        )
    camera = map_.camera_for(camera)
    return OpenedMap(map_, _search(config, camera, map_), camera, stream)


def _search(config: Config, camera: CameraModel, map_: Map | None) -> Search:
    """The search of a map, or of markers alone, in a thread of its own."""
    finder = make_finder(config, camera, map_, _CLOCK)
    if finder is None:
        return NoSearch()
    threads = config.runtime.threads
    place = partial(settle, threads.relocalise_cpus, threads.relocalise_nice)
    return ThreadedSearch(finder, _CLOCK, place)
