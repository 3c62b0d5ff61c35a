# SPDX-License-Identifier: Apache-2.0
"""Draws what a model saw."""

import colorsys

import cv2
import numpy as np

from edge.image.words import write_edged
from edge.types import U8, Detections

_GOLDEN = 0.618034  # turns of hue from class to class: neighbours in the list differ most
_LETTERS = 0.45
_SHARE = 0.5  # of a mask's colour over the image


def draw(image: U8, detections: Detections, names: tuple[str, ...]) -> U8:
    """The image (h, w, 3), red first, with masks, boxes, names and scores; a new array."""
    out = image.copy()
    # The best last, on top of the others.
    for i in reversed(range(len(detections.masks))):
        label = int(detections.classes[i])
        hue = colorsys.hsv_to_rgb(label * _GOLDEN % 1.0, 0.9, 1.0)
        colour = np.array(hue) * 255.0
        mask = detections.masks[i]
        h, w = mask.inside.shape
        part = out[mask.top : mask.top + h, mask.left : mask.left + w]
        mixed = (1.0 - _SHARE) * part[mask.inside] + _SHARE * colour
        part[mask.inside] = mixed.astype(np.uint8)
        left, top, right, bottom = (round(float(v)) for v in detections.boxes[i])
        paint = (float(colour[0]), float(colour[1]), float(colour[2]))
        cv2.rectangle(out, (left, top), (right, bottom), paint, 1)
        text = f"{names[label]} {detections.scores[i]:.2f}"
        place = (max(left, 0), max(top - 4, 12))
        write_edged(out, text, place, _LETTERS, (paint, (0.0, 0.0, 0.0)))
    return out
