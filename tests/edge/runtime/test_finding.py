# SPDX-License-Identifier: Apache-2.0
from pathlib import Path

import msgspec
import numpy as np
import pytest

from edge.config import Config
from edge.errors import ConfigError
from edge.runtime.finding import make_finder
from edge.runtime.stages import replay_pipeline
from edge.tiles.reader import open_map
from tests.edge.relocalise.marked_drive import frames, settings
from tests.maps.small_map import edited_manifest, write_small_map
from tests.maps.wall_drive import CAMERA

N = 50


@pytest.mark.slow
def test_a_marker_alone_gives_metric_poses_from_the_start() -> None:
    config = Config(markers=settings(placed=True))
    off, found, true = [], [], []
    with replay_pipeline(config, CAMERA, None) as pipeline:
        for frame, T in zip(*frames(N), strict=True):
            pose = pipeline.step(frame).pose
            if pose is not None:
                off.append(np.linalg.norm(pose.T_map_cam[:3, 3] - T[:3, 3]))
                found.append(pose.T_map_cam[:3, 3])
                true.append(T[:3, 3])
    assert len(off) > 0.6 * N
    assert max(off) < 0.02
    assert np.median(off) < 0.01
    spread, exact = (float(np.linalg.norm(np.std(p, axis=0))) for p in (found, true))
    assert spread == pytest.approx(exact, rel=0.02)


def test_neither_map_nor_marker_finds_nothing() -> None:
    assert make_finder(Config(), CAMERA, None) is None


def test_markers_in_a_map_without_metres_are_refused(tmp_path: Path) -> None:
    folder = write_small_map(tmp_path / "map").folder
    with edited_manifest(folder) as manifest:
        manifest["metric"] = False
    config = msgspec.structs.replace(Config(), markers=settings(placed=True))
    with pytest.raises(ConfigError, match="--scale"):
        make_finder(config, CAMERA, open_map(folder))
