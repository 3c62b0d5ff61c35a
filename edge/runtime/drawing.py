# SPDX-License-Identifier: Apache-2.0
"""Lines and words on pictures, readable on any ground."""

import cv2
import numpy as np

from edge.image.words import FONT, write_edged
from edge.types import F64, U8, Mask

Colour = tuple[int, int, int]  # blue, green, red
_TEXT_SHARE = 0.0011  # of the picture's height: the size of letters
_DARK = (0, 0, 0)


def outline(picture: U8, pixels: F64, colour: Colour, thickness: int = 2) -> None:
    """The hull of pixels (n, 2)."""
    finite = pixels[np.isfinite(pixels).all(axis=1)]
    if len(finite) < 3:
        return
    hull = cv2.convexHull(np.rint(finite).astype(np.int32))
    cv2.polylines(picture, [hull], True, _DARK, thickness + 2, cv2.LINE_AA)
    cv2.polylines(picture, [hull], True, colour, thickness, cv2.LINE_AA)


def border(
    picture: U8,
    mask: Mask,
    colour: Colour,
    corner: tuple[float, float] = (0.0, 0.0),
    scale: float = 1.0,
) -> None:
    """The edge of a mask, in a picture that begins at a `corner` of its image, so much larger."""
    inside = np.pad(mask.inside.astype(np.uint8), 1)
    contours, _ = cv2.findContours(inside, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    origin = np.array([mask.left - 1.0, mask.top - 1.0]) - corner
    moved = [np.rint(scale * (contour + origin)).astype(np.int32) for contour in contours]
    cv2.polylines(picture, moved, True, _DARK, 4, cv2.LINE_AA)
    cv2.polylines(picture, moved, True, colour, 2, cv2.LINE_AA)


def write(
    picture: U8,
    text: str,
    at: F64 | tuple[float, float],
    colour: Colour,
    edge: Colour = _DARK,
) -> None:
    """Words with an edge of another colour, kept inside the picture."""
    h, w = picture.shape[:2]
    size = _size(picture)
    (width, height), below = cv2.getTextSize(text, FONT, size, 1)
    left = int(np.clip(at[0], 2, max(w - width - 2, 2)))
    base = int(np.clip(at[1], height + 2, max(h - below, height + 2)))
    write_edged(picture, text, (left, base), size, (colour, edge))


def width_of(picture: U8, text: str) -> int:
    """How many columns of a picture these words take."""
    (width, _), _ = cv2.getTextSize(text, FONT, _size(picture), 1)
    return int(width)


def _size(picture: U8) -> float:
    return float(max(_TEXT_SHARE * picture.shape[0], 0.4))


def title(picture: U8, text: str) -> U8:
    """The picture below a line of words."""
    bar: U8 = np.full((26, picture.shape[1], 3), 40, np.uint8)
    cv2.putText(bar, text, (8, 18), FONT, 0.5, (255, 255, 255), 1, cv2.LINE_AA)
    return np.vstack((bar, picture))
