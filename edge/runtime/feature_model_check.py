# SPDX-License-Identifier: Apache-2.0
"""Says how a model of features is understood, and what it finds."""

import time
from pathlib import Path

import cv2
import numpy as np

from edge.learned.model import LearnedModel
from edge.learned.picture import picture
from edge.types import U8

# ruff: noqa: T201  # printing is what this module is for

_COUNT = 1200  # as many as a map takes of an image
_SIZE_PX = (640, 480)
_MARK, _MARK_PX = (40, 220, 40), 3


def check_features(path: Path, image: U8 | None) -> U8 | None:
    """Print what is known of the model; the image (h, w, 3) red first with what it finds there.

    Raises ModelRefused before anything is printed.
    """
    model = LearnedModel(path)
    for line in model.describe():
        print(line)
    shown = picture(*_SIZE_PX) if image is None else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    grey = np.asarray(shown, np.uint8)
    began_s = time.process_time()
    found = model.find(grey, _COUNT)
    taken_ms = 1e3 * (time.process_time() - began_s)
    print(f"runs      {taken_ms:.0f} ms of processor time an image of {_size(grey)}")
    print(f"finds     {len(found.pixels)} key points")
    print("for       mapvo-map build --features, and relocalise.features on the device")
    if image is None:
        return None
    drawn = image.copy()
    for u, v in np.rint(found.pixels).astype(int).tolist():
        cv2.circle(drawn, (u, v), _MARK_PX, _MARK, 1, cv2.LINE_AA)
    return drawn


def _size(image: U8) -> str:
    return f"{image.shape[1]}x{image.shape[0]}"
