# SPDX-License-Identifier: Apache-2.0
"""A simulated room known by a model's features."""

from pathlib import Path

import msgspec
import numpy as np
import pytest

from edge.config import Config
from edge.config.relocalise import RelocaliseConfig
from edge.runtime.replay import ReplayJob, replay
from edge.runtime.run_data import errors_against, read_run, read_truth
from maps.build import BuildInput, build
from maps.settings import BuildSettings
from tests.world.conftest import World
from tools.corner_model import make

pytestmark = [pytest.mark.world, pytest.mark.slow]


def test_a_drive_is_localised_by_a_models_features(world: World, tmp_path: Path) -> None:
    model = make(tmp_path / "corners.onnx")
    source = BuildInput([world.map_drive], every=3)
    build(source, tmp_path / "map", BuildSettings(), features=model)
    relocalise = RelocaliseConfig(features=str(model))
    config = msgspec.structs.replace(Config(), relocalise=relocalise)
    replay(ReplayJob(world.query, tmp_path / "run", tmp_path / "map"), config)
    data = read_run(tmp_path / "run")
    errors = errors_against(read_truth(world.query), data.poses)
    assert len(data.poses.t_ns) > 0.5 * len(data.t_ns)
    assert np.median(errors.position_m) < 0.02  # the room is 6 m wide
    assert np.percentile(errors.position_m, 99) < 0.1
