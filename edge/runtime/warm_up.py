# SPDX-License-Identifier: Apache-2.0
"""Drives the real stages over a tiny recording, so that every kernel is compiled and loaded."""

from dataclasses import replace
from pathlib import Path

from edge.config import Config
from edge.runtime.stages import replay_pipeline
from edge.runtime.synthetic import WallDrive
from edge.tiles.reader import open_map

MAP_FOLDER = Path(__file__).parent / "warm_up_map"
DRIVE_FRAMES = 38
BLIND = range(22, 29)  # long enough to be lost in, so that losing and starting again is driven
LENS = (-0.1, 0.01, 0.0, 0.0)  # any: distorted images take a path of their own
LENS_FRAMES = 2


def warm_up(config: Config) -> None:
    """Run odometry, relocaliser and registration once each way that a run may take."""
    drive = WallDrive(DRIVE_FRAMES, blind=BLIND)
    with replay_pipeline(config, drive.camera, open_map(MAP_FOLDER)) as pipeline:
        for frame in drive:
            pipeline.step(frame)
        pipeline.trajectory()
    distorted = replace(drive.camera, distortion_model="radtan", distortion=LENS)
    with replay_pipeline(config, distorted, None) as pipeline:
        for frame in WallDrive(LENS_FRAMES):
            pipeline.step(frame)
