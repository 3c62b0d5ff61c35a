# SPDX-License-Identifier: Apache-2.0
"""Drives the real stages over a tiny recording, so that every kernel is compiled and loaded."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np

from edge.config import Config
from edge.geometry.camera import CameraModel
from edge.image.pyramid import PyramidBuilder
from edge.odometry.plain import Smoother
from edge.runtime.stages import replay_pipeline
from edge.runtime.synthetic import WallDrive
from edge.runtime.warm_lines import warm_lines
from edge.runtime.warm_plain import warm_plain
from edge.tiles.reader import open_map

MAP_FOLDER = Path(__file__).parent / "warm_up_map"
DRIVE_FRAMES = 38
BLIND = range(22, 29)  # long enough to be lost in, so that losing and starting again is driven
STEADY_FRAMES = 32  # until the window holds enough keyframes to tell something of the lens
# Small images and distorted ones take paths of their own through the image pyramid.
SMALL_CAMERA = CameraModel(320, 240, 280.0, 280.0, 159.5, 119.5)
LENS_CAMERA = replace(SMALL_CAMERA, distortion_model="radtan", distortion=(-0.1, 0.01, 0.0, 0.0))


def warm_up(config: Config, between: Callable[[], None] | None = None) -> None:
    """Run odometry, relocaliser and registration once each way that a run may take.

    `between` is called between two frames.
    """
    with_lines = config.relocalise.landmarks != "points"
    # The map of this package has neither lines nor learned features; kernels are the same for both.
    relocalise = msgspec.structs.replace(config.relocalise, features="orb", landmarks="both")
    config = msgspec.structs.replace(config, relocalise=relocalise)
    drive = WallDrive(DRIVE_FRAMES, blind=BLIND)
    with replay_pipeline(config, drive.camera, open_map(MAP_FOLDER)) as pipeline:
        for frame in drive:
            pipeline.step(frame)
            if between is not None:
                between()
    if with_lines:
        warm_lines(drive.camera)
    _warm_dark_corners()
    _warm_smoothing()
    if config.odometry.start_lines or config.odometry.window_lines:
        warm_plain(drive.camera)
    for camera, frames in ((SMALL_CAMERA, STEADY_FRAMES), (LENS_CAMERA, 2)):
        with replay_pipeline(config, camera, None) as pipeline:
            for frame in WallDrive(frames, camera):
                pipeline.step(frame)
                if between is not None:
                    between()


def _warm_dark_corners() -> None:
    """The drive's lens has none, so that the odometry finds none."""
    builder = PyramidBuilder(SMALL_CAMERA, halvings=0, n_levels=1, n_buffers=1)
    builder.use(builder.undistortion(radial=0.0, readout_s=0.0, falloff=0.1))
    for frame in WallDrive(1, SMALL_CAMERA):
        builder.build(frame.image)


def _warm_smoothing() -> None:
    """Only noisy images and plain ones are smoothed; the drive's are neither."""
    levels = (np.zeros((60, 80, 3), np.float32),)
    Smoother().smoothed(levels, 1.0)
