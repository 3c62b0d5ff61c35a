# SPDX-License-Identifier: Apache-2.0
"""The doctor on models and markers: whether they are there, and those of the map."""

import hashlib

from edge.config import Config
from edge.errors import ModelRefused
from edge.markers.finder import families
from edge.onnx.outline import look_into
from edge.runtime.doctor_host import Finding, Host, bad, doubtful, good
from edge.tiles.manifest import Manifest


def check_models(host: Host, config: Config, manifest: Manifest | None) -> list[Finding]:
    """What the settings name beside the map, whose manifest is None where there is none."""
    return [
        *_features(host, config.relocalise.features, manifest),
        *_segmenter(host, config.segmenter.model, manifest),
        *_markers(config.markers.family),
    ]


def _features(host: Host, name: str, manifest: Manifest | None) -> list[Finding]:
    if name == "orb":
        return []
    sha256, refusal = _look(host, name)
    if sha256 is None:
        return [bad("features", refusal, "set relocalise.features to the model, or to orb")]
    if manifest is None:
        return [doubtful("features", f"{name}: no map to use it in", "see the map's line")]
    learned = manifest.learned
    if learned is None:
        remedy = f'`mapvo-map build ... --features {name}`, or relocalise.features = "orb"'
        return [bad("features", "the map was built without a model of features", remedy)]
    if learned.sha256 != sha256:
        found = f"{name} is not the {learned.model} that the map was built with"
        return [bad("features", found, "copy that file here, or build the map with this one")]
    return [good("features", f"{name}, that of the map")]


def _segmenter(host: Host, name: str, manifest: Manifest | None) -> list[Finding]:
    if not name:
        return []
    sha256, refusal = _look(host, name)
    if sha256 is None:
        return [bad("model", refusal, "set segmenter.model to the model, or leave it out")]
    labels = None if manifest is None else manifest.labels
    if manifest is not None and labels is None:
        remedy = f"`mapvo-map build ... --segmenter {name}`"
        return [doubtful("model", "the map has no labels: no change will be told", remedy)]
    if labels is not None and labels.sha256 != sha256:
        found = f"{name} is not the {labels.model} that labelled the map"
        return [doubtful("model", found, "copy that file here, or build the map with this one")]
    return [good("model", f"{name}; `mapvo model check` tries it")]


def _markers(family: str) -> list[Finding]:
    if not family or family.upper().removeprefix("DICT_") in families():
        return []
    found = f"markers.family {family!r} is unknown"
    return [bad("markers", found, f"name one of {', '.join(families())}")]


def _look(host: Host, name: str) -> tuple[str | None, str]:
    """Hash of a model file, or None and why it cannot be one."""
    path = host.path(name)
    try:
        look_into(path)
        return hashlib.sha256(path.read_bytes()).hexdigest(), ""
    except (ModelRefused, OSError) as error:
        return None, str(error)
