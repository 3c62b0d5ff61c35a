# SPDX-License-Identifier: Apache-2.0
"""Features of a learned model in the form in which maps and searches take them."""

import numpy as np

from edge.config.features import OrbConfig
from edge.geometry.camera import CameraModel
from edge.learned.model import LearnedModel
from edge.relocalise.features import Features
from edge.types import U8


def stated(max_features: int) -> OrbConfig:
    """What a map says of such an extractor: one level, whose features bear a change of size.

    Windows of guided matching reach 1.6 octaves of this factor: from half the size to the double.
    """
    return OrbConfig(max_features=max_features, levels=1, scale_factor=1.5)


class LearnedExtractor:
    """Finds and describes with a model. One thread owns it."""

    def __init__(self, model: LearnedModel, max_features: int) -> None:
        self._model = model
        self._max_features = max_features

    def extract(self, image: U8, camera: CameraModel) -> Features:
        """Features of a grey image (h, w); they have one octave and no orientation."""
        found = self._model.find(image, self._max_features)
        ideal = camera.undistort_pixels(found.pixels).astype(np.float32)
        inside = np.flatnonzero(np.isfinite(ideal).all(axis=1))
        n = len(inside)
        return Features(
            np.ascontiguousarray(ideal[inside]),
            np.ascontiguousarray(self._model.codes(found)[inside]),
            np.zeros(n, np.uint8),
            np.zeros(n, np.float32),
            found.pixels[inside],
        )
