# SPDX-License-Identifier: Apache-2.0
"""Keeps people and other things that move by themselves out of a map."""

import numpy as np

from edge.changes.cover import grown, holds
from edge.geometry.camera import CameraModel
from edge.relocalise.bow import shipped_vocabulary
from edge.types import F32, F64, Bools, DepthSamples, Mask
from maps.describe import Description
from maps.labels.looking import Sightings
from maps.views import ViewSet

_EDGE_PX = 5  # masks end early


def without_moving(
    descriptions: list[Description], chosen: ViewSet, seen: Sightings | None
) -> list[Description]:
    """The descriptions of all views without features and depths on what moves."""
    if seen is None:
        return descriptions
    cleared = []
    for k, (view, description) in enumerate(zip(chosen.views, descriptions, strict=True)):
        masks = [grown(mask, _EDGE_PX) for mask in seen.moving(k)]
        camera = chosen.cameras[view.camera]
        cleared.append(_cleared(description, camera, masks) if masks else description)
    return cleared


def _cleared(description: Description, camera: CameraModel, masks: list[Mask]) -> Description:
    features, samples = description.features, description.samples
    kept = ~_held(masks, features.raw_pixels)
    pixels = camera.distort_pixels(samples.pixels.astype(np.float64))
    still = ~_held(masks, pixels)
    cleared = features._replace(
        pixels=features.pixels[kept],
        descriptors=features.descriptors[kept],
        octave=features.octave[kept],
        angle_rad=features.angle_rad[kept],
        raw_pixels=features.raw_pixels[kept],
    )
    return Description(
        cleared,
        shipped_vocabulary().describe(cleared.descriptors),
        description.depth[kept],
        description.depth_sigma[kept],
        DepthSamples(samples.pixels[still], samples.inverse_depth[still], samples.sigma[still]),
    )


def _held(masks: list[Mask], pixels: F32 | F64) -> Bools:
    held: Bools = np.zeros(len(pixels), bool)
    for mask in masks:
        held |= holds(mask, pixels)
    return held
