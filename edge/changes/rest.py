# SPDX-License-Identifier: Apache-2.0
"""What is left of a mask beside the objects of the map that it holds.

Models take two things of a kind for one that touch, or stand behind one another. The map knows
where one of them ends.
"""

from collections.abc import Iterator, Sequence

import cv2
import numpy as np

from edge.changes.explain import Shown, explains
from edge.changes.glimpse import Glimpse, Ranger, glimpses
from edge.types import U8, Detections, Mask

_MARGIN = 0.1  # of an object's side: space that masks carve does not quite agree with the next
_LEAST_MARGIN_PX = 3.0  # errors of pose and mask
_OF_OBJECT = 0.4  # as large as the object must be what is left
_NARROW = 0.3  # of its side: what is no wider is its own border
_FOUND = 0.9  # of the images that must have shown it
_FAR_PX = 1e4  # beyond any image


def rests(seen: Sequence[Glimpse], shown: Sequence[Shown], ranger: Ranger) -> Iterator[Glimpse]:
    """What masks hold beside the objects of their class that explain them.

    Where one ends is known of those only that the map's images found nearly always.
    """
    there = [part for part in shown if not part.known.was_told]
    for g in seen:
        own = [s for s in there if s.known.thing.label == g.label and explains(s, g)]
        known_well = own and all(s.known.thing.hit_rate >= _FOUND for s in own)
        rest = _beside(g.mask, own) if known_well else None
        if rest is not None:
            h, w = rest.inside.shape
            found = Detections(
                np.array([[rest.left, rest.top, rest.left + w, rest.top + h]], np.float32),
                np.array([g.score], np.float32),
                np.array([g.label], np.int32),
                (rest,),
            )
            yield from glimpses(found, g.T_map_cam, g.camera, ranger)


def _beside(mask: Mask, own: Sequence[Shown]) -> Mask | None:
    """The largest part of a mask beside all of these objects; None where there is none."""
    left: U8 = mask.inside.astype(np.uint8)
    corner = np.array([mask.left, mask.top])
    side = 0.0  # of the largest [px]
    for part in own:
        pixels = np.clip(part.pixels - corner, -_FAR_PX, _FAR_PX)
        hull = np.rint(cv2.convexHull(pixels.astype(np.float32))).astype(np.int32)
        size = max(float(np.sqrt(cv2.contourArea(hull))), 1.0)
        margin = round(max(_MARGIN * size, _LEAST_MARGIN_PX))
        cv2.fillConvexPoly(left, hull, 0)
        cv2.polylines(left, [hull], isClosed=True, color=0, thickness=2 * margin + 1)
        side = max(side, size)
    least = _OF_OBJECT * side**2
    # An object right before the camera is larger than any image: opening by its side took 20 s.
    if np.count_nonzero(left) < max(least, 1.0):
        return None
    width = 2 * int(0.5 * _NARROW * side) + 1
    # Beyond its box there is nothing of the mask: without a border, OpenCV would go on there.
    wide = np.pad(left, width)
    wide = cv2.morphologyEx(wide, cv2.MORPH_OPEN, np.ones((width, width), np.uint8))
    _, parts, stats, _ = cv2.connectedComponentsWithStats(wide[width:-width, width:-width])
    areas = stats[1:, cv2.CC_STAT_AREA]
    if not (areas >= least).any():
        return None
    n = 1 + int(areas.argmax())
    x, y, w, h = stats[n, :4].tolist()
    return Mask(mask.left + x, mask.top + y, parts[y : y + h, x : x + w] == n)
