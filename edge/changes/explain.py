# SPDX-License-Identifier: Apache-2.0
"""Which object of the map a mask is of: by its place first, and by its name where that is moot."""

import numpy as np

from edge.changes.cover import holds
from edge.changes.expect import Expectation
from edge.changes.glimpse import Glimpse
from edge.changes.known import Known
from edge.geometry.camera import CameraModel
from edge.types import F32, Mask

_EXPLAINED = 0.3  # of an object's space, under a mask of like size
_ALIKE_SIZE = 4.0
_BESIDE_PX = 8.0
_RENAMED = 0.4  # the boxes of an object and of a mask of another name overlap by so much
_WITHIN = 0.7  # of a mask, within the box of an object's space: it is a part of it


def is_shown_in_part(found: Expectation, camera: CameraModel) -> bool:
    """Whether any of its points lies in the image."""
    limit = np.array([camera.width, camera.height]) - 1.0
    return bool(((found.pixels >= 0.0) & (found.pixels <= limit)).all(axis=1).any())


def explains(known: Known, found: Expectation, g: Glimpse, pixels: F32) -> bool:
    """Whether a mask is of an object of the map, whose space is seen at pixels (n, 2)."""
    area = float(g.mask.inside.sum())
    box = float(np.maximum(np.ptp(pixels, axis=0), 3.0).prod())
    held = float(holds(g.mask, pixels).mean())
    if g.label != known.thing.label:  # detectors rename things, but do not move them
        return held >= _EXPLAINED and _overlap(g.mask, pixels) >= _RENAMED
    if area < _ALIKE_SIZE * box and held >= _EXPLAINED:
        return True
    # What stands before it, or the image's border, leaves a part of it.
    return _share_within(g.mask, pixels) >= _WITHIN


def is_beside(known: Known, found: Expectation, g: Glimpse) -> bool:
    """Whether a mask of its name is so near that it may be of it, if map or pose are off."""
    if g.label != known.thing.label:
        return False
    pixels = found.pixels[np.isfinite(found.pixels).all(axis=1)]
    sides = np.maximum(np.ptp(pixels, axis=0), _BESIDE_PX)
    h, w = g.mask.inside.shape
    middle = np.array([g.mask.left + 0.5 * w, g.mask.top + 0.5 * h])
    return bool((np.abs(middle - pixels.mean(axis=0)) < sides).all())


def _overlap(mask: Mask, pixels: F32) -> float:
    """Overlap of the box of a mask and that around pixels (n, 2), as a share of both."""
    h, w = mask.inside.shape
    low, high = pixels.min(axis=0), pixels.max(axis=0) + 1.0
    corner = np.array([mask.left, mask.top], np.float64)
    common = np.minimum(high, corner + np.array([w, h])) - np.maximum(low, corner)
    inner = float(np.maximum(common, 0.0).prod())
    both = w * h + float((high - low).prod()) - inner
    return float(inner / both)


def _share_within(mask: Mask, pixels: F32) -> float:
    """Share of a mask that lies within the box around pixels (n, 2)."""
    low, high = pixels.min(axis=0) - 1.0, pixels.max(axis=0) + 1.0
    rows, columns = np.nonzero(mask.inside)
    at = np.stack([columns + mask.left, rows + mask.top], axis=1)
    return float(((at >= low) & (at <= high)).all(axis=1).mean())
