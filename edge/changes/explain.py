# SPDX-License-Identifier: Apache-2.0
"""Which object of the map a mask is of: by its place first, and by its name where that is moot."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from edge.changes.cover import between, holds, reaches
from edge.changes.expect import Expectation
from edge.changes.glimpse import Glimpse
from edge.changes.known import Known
from edge.changes.map_sightings import RENAMED
from edge.geometry.camera import CameraModel
from edge.types import F32, Mask

_EXPLAINED = 0.3  # of an object's space, under a mask of like size
_ALIKE_SIZE = 4.0
_BESIDE_PX = 8.0
_SURELY = 1.5  # deviations of a measured distance
_WITHIN = 0.7  # of a mask, within the box of an object's space: it is a part of it


class Shown(NamedTuple):
    """An object of the map that is in an image, if only in part."""

    known: Known
    found: Expectation
    pixels: F32  # (n, 2) those of its space that the lens sees
    low: F32  # (2,) the box around them
    high: F32


def shown_part(known: Known, found: Expectation, camera: CameraModel) -> Shown | None:
    """What an image shows of an object; None where none of its points lies in it."""
    limit = (camera.width - 1.0, camera.height - 1.0)
    if not between(found.pixels, (0.0, 0.0), limit).any():
        return None
    pixels = found.pixels[np.isfinite(found.pixels[:, 0])]
    return Shown(known, found, pixels, pixels.min(axis=0), pixels.max(axis=0))


def explains(shown: Shown, g: Glimpse) -> bool:
    """Whether a mask is of an object of the map."""
    if not reaches(g.mask, shown.low, shown.high):
        return False
    area = float(g.mask.inside.sum())
    box = float(np.maximum(shown.high - shown.low, 3.0).prod())
    held = float(holds(g.mask, shown.pixels).mean())
    if g.label != shown.known.thing.label:  # detectors rename things, but do not move them
        renamed = _was_named(shown.known, g.label)
        return renamed and held >= _EXPLAINED and _overlap(g.mask, shown) >= RENAMED
    if area < _ALIKE_SIZE * box and held >= _EXPLAINED:
        return True
    # What stands before it, or the image's border, leaves a part of it.
    return _share_within(g.mask, shown) >= _WITHIN


class Claims(NamedTuple):
    """Masks over an object, or about it."""

    own: list[Mask]  # that may be of it
    unknown: list[Mask]  # of which nobody knows what they are of


def claims(shown: Shown, seen: Sequence[Glimpse], others: Sequence[Shown]) -> Claims:
    """What the masks of an image may have to do with an object, where `others` are in it, too.

    Masks of other objects are left out, and those of what it stands on or before: of a class that
    held it in the map's images as well.
    """
    found = Claims([], [])
    for g in seen:
        if not reaches(g.mask, shown.low, shown.high):
            continue
        if g.label == shown.known.thing.label or (
            _was_named(shown.known, g.label) and may_be_renamed(shown, g)
        ):
            found.own.append(g.mask)
        elif not (
            g.label in shown.known.company
            or _is_behind(shown, g)
            or any(o.known.thing.label == g.label and explains(o, g) for o in others)
        ):
            found.unknown.append(g.mask)
    return found


def may_be_renamed(shown: Shown, g: Glimpse) -> bool:
    """Whether a mask lies so much where an object is that it may be of it, whatever its name."""
    return _overlap(g.mask, shown) >= RENAMED


def _was_named(known: Known, label: int) -> bool:
    """Whether the map's images may have given an object that name, too."""
    return known.aliases is None or label in known.aliases


def _is_behind(shown: Shown, g: Glimpse) -> bool:
    """Whether the front of what a mask is of is surely behind an object's middle."""
    middle_m = float(np.linalg.norm(shown.known.thing.center - g.origin))
    return g.distance_m - _SURELY * g.distance_sigma_m > middle_m


def is_beside(shown: Shown, g: Glimpse) -> bool:
    """Whether a mask of its name is so near that it may be of it, if map or pose are off."""
    if g.label != shown.known.thing.label:
        return False
    sides = np.maximum(shown.high - shown.low, _BESIDE_PX)
    h, w = g.mask.inside.shape
    middle = np.array([g.mask.left + 0.5 * w, g.mask.top + 0.5 * h])
    return bool((np.abs(middle - shown.pixels.mean(axis=0)) < sides).all())


def _overlap(mask: Mask, shown: Shown) -> float:
    """Overlap of the box of a mask and that of an object, as a share of both."""
    h, w = mask.inside.shape
    low, high = shown.low, shown.high + 1.0
    corner = np.array([mask.left, mask.top], np.float64)
    common = np.minimum(high, corner + np.array([w, h])) - np.maximum(low, corner)
    inner = float(np.maximum(common, 0.0).prod())
    both = w * h + float((high - low).prod()) - inner
    return float(inner / both)


def _share_within(mask: Mask, shown: Shown) -> float:
    """Share of a mask that lies within the box of an object."""
    rows, columns = np.nonzero(mask.inside)
    at = np.stack([columns + mask.left, rows + mask.top], axis=1)
    return float(between(at, shown.low - 1.0, shown.high + 1.0).mean())
