# SPDX-License-Identifier: Apache-2.0
"""The relocaliser by the features that the settings name: ORB's, or a learned model's."""

from pathlib import Path

from edge.config.relocalise import RelocaliseConfig
from edge.errors import ConfigError
from edge.geometry.camera import CameraModel
from edge.lines.work import Clock, no_clock
from edge.relocalise.relocaliser import Relocaliser
from edge.tiles.learned import LearnedMap
from edge.tiles.reader import Map
from edge.tiles.residency import DEFAULT_BYTES


def make_relocaliser(
    map_: Map,
    camera: CameraModel,
    config: RelocaliseConfig,
    resident_bytes: int = DEFAULT_BYTES,
    clock: Clock = no_clock,
) -> Relocaliser:
    """What finds images in the map; ConfigError where its features are of another model."""
    if config.features == "orb":
        return Relocaliser(map_, camera, config, clock=clock)
    # Imported here: ONNX Runtime takes time and memory that ORB does not need.
    from edge.learned.extractor import LearnedExtractor
    from edge.learned.model import LearnedModel

    path, learned = Path(config.features), map_.manifest.learned
    if learned is None:
        raise ConfigError(
            f'relocalise.features: {map_.folder} has none but ORB\'s; set "orb", or build it with '
            f"--features {path}"
        )
    model = LearnedModel(path)
    if model.sha256 != learned.sha256:
        raise ConfigError(
            f"relocalise.features: {map_.folder} was built with {learned.model} "
            f"(sha256 {learned.sha256[:12]}), {path} is {model.sha256[:12]}; use that one, or "
            "build the map again"
        )
    extractor = LearnedExtractor(model, learned.extractor.max_features)
    return Relocaliser(LearnedMap(map_, resident_bytes), camera, config, extractor, clock)
