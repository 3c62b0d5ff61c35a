# SPDX-License-Identifier: Apache-2.0
"""Whether an image shows an object as it looked when the map was made, whatever a model says.

Both are sampled on one square of the plane through the object's middle, so that neither lens nor
distance matters; then they are compared by their normalised correlation, which light and exposure
leave as it is. What has gone leaves something else in the middle of that square.
"""

import cv2
import numpy as np

from edge.geometry import se3
from edge.geometry.camera import CameraModel
from edge.tiles.labels import MapObject, Portrait
from edge.tiles.tile import PORTRAIT_CELLS
from edge.types import F32, F64, U8, Bools, Mat4

# From further beside, or from much nearer or farther, a thing with depth looks otherwise.
ALIKE_DEG, ALIKE_RATIO = 15.0, 1.8
_COMPARED = 3  # portraits, the nearest first
_SHIFT_CELLS = 3  # errors of pose and place move the image by less
_MOST_SAMPLES = 4  # a side of a cell
# Correlation of the thing with what is around it, and of the thing alone. In none of 4198 images
# in which 222 things had gone from rooms and kitchens were both as high; a model that missed what
# was there was set right in 109 of 488.
_WHOLE, _ITSELF = 0.9, 0.92
_AROUND_CELLS = 4
_LEAST_CELLS = 12  # of the thing
_DISC = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * _AROUND_CELLS + 1,) * 2)
_FLAT_GREY = 2.0  # deviation up to which an image's noise decides


def is_as_portrayed(thing: MapObject, image: U8, camera: CameraModel, T_map_cam: Mat4) -> bool:
    """Whether a raw grey `image` (h, w) shows a thing as one of its portraits does."""
    if not thing.portraits:
        return False
    away = T_map_cam[:3, 3] - thing.center
    distance_m = float(np.linalg.norm(away))
    cosines = thing.view_directions @ (away / max(distance_m, 1e-9))
    for portrait in sorted(thing.portraits, key=lambda p: -cosines[p.view])[:_COMPARED]:
        from_m = float(np.linalg.norm(thing.cameras[portrait.view] - thing.center))
        is_near = 1.0 / ALIKE_RATIO < distance_m / max(from_m, 1e-9) < ALIKE_RATIO
        if not is_near or cosines[portrait.view] < np.cos(np.radians(ALIKE_DEG)):
            continue
        now = sampled(thing, portrait, image, camera, T_map_cam, _SHIFT_CELLS)
        if now is not None and _are_alike(portrait.grey, now, _itself(thing, portrait)):
            return True
    return False


def nearest_portrait(thing: MapObject, place: F64) -> Portrait | None:
    """The portrait that was taken most nearly from the direction of a `place` (3,) [m]."""
    away = place - thing.center
    return max(
        thing.portraits, key=lambda p: float(thing.view_directions[p.view] @ away), default=None
    )


def corners(thing: MapObject, portrait: Portrait) -> F64:
    """Middles (4, 3) of the square's corner cells, round from that of row and column 0 [m]."""
    half_m = 0.5 * portrait.side_m * (PORTRAIT_CELLS - 1) / PORTRAIT_CELLS
    signs = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    places: F64 = thing.center + half_m * signs @ _axes(thing, portrait)
    return places


def sampled(
    thing: MapObject,
    portrait: Portrait,
    image: U8,
    camera: CameraModel,
    T_map_cam: Mat4,
    margin: int = 0,
) -> F32 | None:
    """The square of a portrait in a raw grey image: (n, n) float32, n = PORTRAIT_CELLS + 2 margin.

    `margin` cells are added on each side. None where the square is not wholly in the image.
    """
    axes = _axes(thing, portrait)
    n = PORTRAIT_CELLS + 2 * margin
    cell_m = portrait.side_m / PORTRAIT_CELLS
    distance_m = float(np.linalg.norm(T_map_cam[:3, 3] - thing.center))
    per_cell = camera.fx * cell_m / max(distance_m, 1e-9)
    samples = n * int(np.clip(np.ceil(per_cell), 1, _MOST_SAMPLES))
    steps = ((np.arange(samples) + 0.5) / samples - 0.5) * n * cell_m
    along, down = np.meshgrid(steps, steps)
    at = thing.center + along.reshape(-1, 1) * axes[0] + down.reshape(-1, 1) * axes[1]
    pixels = camera.project(se3.transform(se3.inverse(T_map_cam), at)).astype(np.float32)
    limit = np.array([camera.width, camera.height]) - 1.0
    if not ((pixels >= 0.0) & (pixels <= limit)).all():  # nor where it is NaN
        return None
    maps = pixels.reshape(samples, samples, 2)
    fine = cv2.remap(image, maps[..., 0], maps[..., 1], cv2.INTER_LINEAR)
    return np.asarray(cv2.resize(fine.astype(np.float32), (n, n), interpolation=cv2.INTER_AREA))


def _are_alike(before: U8, now: F32, itself: Bools) -> bool:
    """Whether `now`, larger by its margins, shows the thing of the picture `before`."""
    if itself.sum() < _LEAST_CELLS:
        return False
    then, around = before.astype(np.float32), cv2.dilate(itself.astype(np.uint8), _DISC)
    if min(float(then[around > 0].std()), float(now.std())) < _FLAT_GREY:
        return False
    likeness = cv2.matchTemplate(now, then, cv2.TM_CCOEFF_NORMED, mask=around.astype(np.float32))
    row, column = np.unravel_index(int(np.nan_to_num(likeness).argmax()), likeness.shape)
    there = now[row : row + len(then), column : column + len(then)]
    return (
        _correlation(then[around > 0], there[around > 0]) >= _WHOLE
        and _correlation(then[itself], there[itself]) >= _ITSELF
    )


def _correlation(a: F32, b: F32) -> float:
    if min(float(a.std()), float(b.std())) < _FLAT_GREY:
        return 0.0
    return float(np.corrcoef(a, b)[0, 1])


def _axes(thing: MapObject, portrait: Portrait) -> F64:
    """Unit vectors (2, 3) along rows and columns of the square."""
    down = np.cross(-thing.view_directions[portrait.view], portrait.right)
    return np.stack([portrait.right, down])


def _itself(thing: MapObject, portrait: Portrait) -> Bools:
    """Cells (PORTRAIT_CELLS, PORTRAIT_CELLS) that the thing covers, as seen from there."""
    camera, center = thing.cameras[portrait.view], thing.center
    along = thing.points - camera
    onto = -thing.view_directions[portrait.view]
    reach = float((center - camera) @ onto) / np.maximum(along @ onto, 1e-9)
    flat = (camera + along * reach[:, None] - center) @ _axes(thing, portrait).T
    cells = flat / (portrait.side_m / PORTRAIT_CELLS) + 0.5 * (PORTRAIT_CELLS - 1)
    inside = np.zeros((PORTRAIT_CELLS, PORTRAIT_CELLS), np.uint8)
    hull = cv2.convexHull(np.rint(cells).astype(np.int32))
    cv2.fillConvexPoly(inside, hull, 1)
    return inside > 0
