# SPDX-License-Identifier: Apache-2.0
"""Strokes that pictures are made of: made-up words, random shapes."""

import cv2
import numpy as np

from edge.types import U8
from tools.simworld.materials import Size
from tools.simworld.noise import Bgr

LETTERS = "ABCDEFGHIJKLMNOPRSTUVWXYZabdefghijkmnopqrstuvy0123456789&%?!"
FONTS = (cv2.FONT_HERSHEY_SIMPLEX, cv2.FONT_HERSHEY_DUPLEX, cv2.FONT_HERSHEY_COMPLEX,
         cv2.FONT_HERSHEY_TRIPLEX)  # fmt: skip
INK: Bgr = (40, 36, 34)


def filled(size: Size, colour: Bgr) -> U8:
    """An image of one colour."""
    return np.full((*size, 3), np.rint(colour), dtype=np.uint8)


def vivid(rng: np.random.Generator) -> Bgr:
    """A colour between pastel and dark, well away from full saturation."""
    hsv = np.array([[[rng.integers(0, 180), rng.integers(40, 170), rng.integers(60, 235)]]])
    b, g, r = cv2.cvtColor(hsv.astype(np.uint8), cv2.COLOR_HSV2BGR)[0, 0]
    return float(b), float(g), float(r)


def write_line(
    image: U8, rng: np.random.Generator, at: tuple[int, int], height: float, end: int, ink: Bgr
) -> None:
    """Words of made-up letters from `at` (left, baseline) up to column `end`."""
    font = int(rng.choice(FONTS))
    scale = height / 22.0
    thick = max(1, round(height / 14.0))
    x, y = at
    while True:
        word = "".join(rng.choice(list(LETTERS), rng.integers(2, 9)))
        (width, _), _ = cv2.getTextSize(word, font, scale, thick)
        if x + width > end:
            return
        cv2.putText(image, word, (int(x), int(y)), font, scale, ink, thick, cv2.LINE_AA)
        x += width + round(0.6 * height)


def write_block(
    image: U8, rng: np.random.Generator, box: tuple[int, int, int, int], height: float, ink: Bgr
) -> None:
    """Lines of text in the rectangle (left, top, right, bottom)."""
    left, top, right, bottom = box
    y = top + height
    while y < bottom:
        end = right if rng.random() > 0.2 else left + int(rng.uniform(0.3, 0.9) * (right - left))
        write_line(image, rng, (left, round(y)), height, end, ink)
        y += 1.7 * height


def add_shape(image: U8, rng: np.random.Generator, reach: float) -> None:
    """One random disc, ring, polygon, bar or triangle fan of up to `reach` pixels."""
    h, w = image.shape[:2]
    if h < 2 or w < 2:
        return
    x, y = int(rng.integers(0, w)), int(rng.integers(0, h))
    r = int(rng.uniform(0.25, 1.0) * reach)
    colour = vivid(rng)
    kind = rng.integers(0, 5)
    if kind == 0:
        cv2.circle(image, (x, y), r, colour, -1, cv2.LINE_AA)
    elif kind == 1:
        cv2.circle(image, (x, y), r, colour, max(2, r // 4), cv2.LINE_AA)
    elif kind == 2:
        angles = np.sort(rng.uniform(0, 2 * np.pi, rng.integers(3, 8)))
        corners = np.stack([x + r * np.cos(angles), y + r * np.sin(angles)], axis=1)
        cv2.fillPoly(image, [np.rint(corners).astype(np.int32)], colour, cv2.LINE_AA)
    elif kind == 3:
        box = ((x, y), (2 * r, max(3, r // 3)), float(rng.uniform(0, 180)))
        cv2.fillPoly(image, [np.rint(cv2.boxPoints(box)).astype(np.int32)], colour, cv2.LINE_AA)
    else:
        axes = (r, max(2, int(r * rng.uniform(0.3, 0.9))))
        cv2.ellipse(
            image, (x, y), axes, float(rng.uniform(0, 180)), 0, 360, colour, -1, cv2.LINE_AA
        )
