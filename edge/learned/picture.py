# SPDX-License-Identifier: Apache-2.0
"""A picture full of corners of every size, always the same, to try a model on."""

import cv2
import numpy as np

from edge.types import F32, U8

_SEED = 7
_OCTAVES = 7
_PATCHES = 150
_PATCH_PX = (6, 90)


def picture(width: int, height: int) -> U8:
    """Grey image (h, w): blotches as strong as in photographs, and patches with sharp edges."""
    rng = np.random.default_rng(_SEED)
    image: F32 = np.zeros((height, width), np.float32)
    for k in range(1, _OCTAVES + 1):
        coarse = rng.standard_normal((max(height >> k, 2), max(width >> k, 2))).astype(np.float32)
        image += np.float32(2.0 ** (k / 1.5)) * cv2.resize(coarse, (width, height))
    for _ in range(_PATCHES):
        x, y = int(rng.integers(width)), int(rng.integers(height))
        w, h = rng.integers(*_PATCH_PX, 2).tolist()
        patch = image[y : y + h, x : x + w]
        patch[:] = 0.2 * patch + rng.normal(0.0, 25.0)
    smooth = cv2.GaussianBlur(image, (0, 0), 1.0)
    even = (smooth - smooth.mean()) / max(float(smooth.std()), 1e-6)
    grey: U8 = np.clip(50.0 * even + 128.0, 0, 255).astype(np.uint8)
    return grey
