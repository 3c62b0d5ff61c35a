# SPDX-License-Identifier: Apache-2.0
"""Drives the real stages over a tiny recording, so that every kernel is compiled and loaded."""

from pathlib import Path

from edge.config import Config
from edge.runtime.stages import replay_pipeline
from edge.runtime.synthetic import WallDrive
from edge.tiles.reader import open_map

MAP_FOLDER = Path(__file__).parent / "warm_up_map"
DRIVE_FRAMES = 60
BLIND = range(30, 38)  # long enough to be lost in, so that losing and starting again is driven


def warm_up(config: Config) -> None:
    """Run odometry, relocaliser and registration once each way that a run may take."""
    drive = WallDrive(DRIVE_FRAMES, blind=BLIND)
    with replay_pipeline(config, drive.camera, open_map(MAP_FOLDER)) as pipeline:
        for frame in drive:
            pipeline.step(frame)
        pipeline.trajectory()
