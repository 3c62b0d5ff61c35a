# SPDX-License-Identifier: Apache-2.0
"""Makes the stages from a configuration and joins them."""

import time

from edge.config import Config
from edge.geometry.camera import CameraModel
from edge.odometry.odometry import Odometry
from edge.registration.registration import Registration
from edge.relocalise.relocaliser import Relocaliser
from edge.runtime.pipeline import Pipeline
from edge.runtime.search import DelayedSearch, NoSearch, Search, ThreadedSearch
from edge.tiles.reader import Map


def make_pipeline(
    config: Config, camera: CameraModel, map_: Map | None, *, realtime: bool
) -> Pipeline:
    """The whole pipeline; in real time the relocaliser has a thread of its own."""
    clock = time.monotonic_ns if realtime else time.thread_time_ns
    search: Search = NoSearch()
    if map_ is not None:
        relocaliser = Relocaliser(map_, camera, config.relocalise)
        if realtime:
            search = ThreadedSearch(relocaliser, clock)
        else:
            delay_frames = config.runtime.relocalise_delay_frames
            search = DelayedSearch(relocaliser, delay_frames, clock)
    return Pipeline(
        Odometry(camera, config.odometry),
        Registration(config.registration),
        search,
        config.runtime,
        clock,
    )
