# SPDX-License-Identifier: Apache-2.0
"""Makes the stages from a configuration and joins them."""

import time
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager

from edge.config import Config
from edge.geometry.camera import CameraModel
from edge.odometry.keyframe_work import KeyframeWorker
from edge.odometry.odometry import Odometry
from edge.registration.registration import Registration
from edge.runtime.finding import make_finder
from edge.runtime.keyframe_worker import (
    InlineKeyframeWorker,
    KeyframeTimes,
    ThreadedKeyframeWorker,
)
from edge.runtime.pipeline import Pipeline
from edge.runtime.search import Clock, DelayedSearch, NoSearch, Search, ThreadedSearch
from edge.tiles.reader import Map


@contextmanager
def replay_pipeline(config: Config, camera: CameraModel, map_: Map | None) -> Iterator[Pipeline]:
    """All stages in one thread; what works beside it live takes effect as many frames later."""
    clock = time.thread_time_ns
    times = KeyframeTimes(clock, inline=True)
    worker = InlineKeyframeWorker(config.odometry.keyframe_delay_frames, times)
    search: Search = NoSearch()
    if map_ is not None:
        camera = map_.camera_for(camera)  # odometry and map must see through one lens
    if (finder := make_finder(config, camera, map_, clock)) is not None:
        runtime = config.runtime
        search = DelayedSearch(
            finder, runtime.relocalise_delay_frames, clock, runtime.relocalise_delay_s
        )
    odometry, registration = _stages(config, camera, worker, clock)
    yield Pipeline(odometry, registration, search, config.runtime, clock, times)


@contextmanager
def live_pipeline(config: Config, camera: CameraModel, map_: Map | None) -> Iterator[Pipeline]:
    """Tracking in the caller's thread; keyframe work and relocaliser each in its own."""
    clock = time.monotonic_ns
    times = KeyframeTimes(clock, inline=False)
    with ExitStack() as stack:
        worker = stack.enter_context(closing(ThreadedKeyframeWorker(times)))
        search: Search = NoSearch()
        if map_ is not None:
            camera = map_.camera_for(camera)
        if (finder := make_finder(config, camera, map_, clock)) is not None:
            search = stack.enter_context(closing(ThreadedSearch(finder, clock)))
        odometry, registration = _stages(config, camera, worker, clock)
        yield Pipeline(odometry, registration, search, config.runtime, clock, times)


def _stages(
    config: Config, camera: CameraModel, worker: KeyframeWorker, clock: Clock
) -> tuple[Odometry, Registration]:
    odometry = Odometry(camera, config.odometry, worker, clock)
    return odometry, Registration(config.registration)
