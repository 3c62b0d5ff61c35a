# SPDX-License-Identifier: Apache-2.0
"""Faces of made things: doors, drawers, windows, keys, cartons."""

import cv2
import numpy as np

from edge.types import U8
from tools.simworld.drawing import INK, filled, write_block, write_line
from tools.simworld.materials import Painter, Size, wood
from tools.simworld.noise import Bgr, blend, fractal, tint, to_bytes


def keyboard(rng: np.random.Generator, size: Size, colour: Bgr) -> U8:
    """Rows of keys with letters."""
    h, w = size
    image = filled(size, colour)
    step = h // 6
    for row in range(6):
        x = 4 + (row * step) // 4
        while x < w - step:
            wide = step if rng.random() < 0.88 else 2 * step
            corner = (x + wide - 4, (row + 1) * step - 3)
            tone = 60.0 if sum(colour) > 330 else 190.0
            cv2.rectangle(image, (x, row * step + 3), corner, (tone, tone, tone), -1)
            at = (x + 4, (row + 1) * step - step // 3)
            write_line(image, rng, at, 0.35 * step, x + wide, colour)
            x += wide
    return image


def carton(rng: np.random.Generator, size: Size, colour: Bgr) -> U8:
    """Corrugated board with tape, a label and stamps."""
    h, w = size
    waves = np.sin(np.linspace(0, 40 * 2 * np.pi, w, dtype=np.float32))[None, :]
    image = to_bytes(tint(colour, 1 + 0.02 * waves + 0.05 * fractal(rng, size, (8, 8), 5, 0.7)))
    cv2.rectangle(image, (0, round(0.44 * h)), (w, round(0.56 * h)), (110, 165, 190), -1)
    x, y = int(rng.uniform(0.05, 0.4) * w), int(rng.uniform(0.1, 0.5) * h)
    x1, y1 = x + round(0.5 * w), y + round(0.38 * h)
    cv2.rectangle(image, (x, y), (x1, y1), (232, 234, 236), -1)
    write_block(image, rng, (x + 6, y + 4, x1, y1 - 4), 0.05 * h, INK)
    write_line(image, rng, (round(0.05 * w), round(0.95 * h)), 0.08 * h, w, INK)
    return image


def view(rng: np.random.Generator, size: Size, colour: Bgr) -> U8:
    """A window: bright sky over blurred roofs, with a frame and a cross bar."""
    h, w = size
    image = tint(colour, 1 + 0.03 * fractal(rng, size, (2, 3), 5))
    roofs = h * 0.72 + 0.07 * h * np.sign(fractal(rng, (8, w), (1, 14), 1))[:1]
    below = np.clip((np.arange(h, dtype=np.float32)[:, None] - roofs) * 0.2, 0, 1)
    done = to_bytes(
        blend(image, tint((165, 160, 160), 1 + 0.1 * fractal(rng, size, (9, 9), 4)), below)
    )
    bar = max(w // 24, 4)
    frame: Bgr = (205.0, 208.0, 210.0)
    cv2.rectangle(done, (0, 0), (w - 1, h - 1), frame, 2 * bar)
    cv2.line(done, (w // 2, 0), (w // 2, h), frame, bar)
    cv2.line(done, (0, h // 3), (w, h // 3), frame, bar)
    return done


def panels(rng: np.random.Generator, size: Size, colour: Bgr) -> U8:
    """A door leaf: four sunk panels with light and dark rims."""
    h, w = size
    image = to_bytes(tint(colour, 1 + 0.008 * fractal(rng, size, (3, 3), 4)))
    light = tuple(min(255.0, 1.12 * c) for c in colour)
    dark = tuple(0.72 * c for c in colour)
    for y0, y1 in ((0.06, 0.42), (0.52, 0.94)):
        for x0, x1 in ((0.12, 0.45), (0.55, 0.88)):
            a, b = (round(x0 * w), round(y0 * h)), (round(x1 * w), round(y1 * h))
            cv2.rectangle(image, a, b, dark, 5)
            cv2.rectangle(image, (a[0] + 5, a[1] + 5), (b[0] + 5, b[1] + 5), light, 3)
    return image


def drawers(rng: np.random.Generator, size: Size, colour: Bgr) -> U8:
    """Three wooden drawer fronts with handles and gaps."""
    h, w = size
    image = wood(rng, size, colour)
    for i in range(3):
        y0, y1 = i * h // 3, (i + 1) * h // 3
        cv2.rectangle(image, (2, y0 + 2), (w - 3, y1 - 3), (30, 30, 30), 3)
        y = (y0 + y1) // 2
        cv2.line(image, (round(0.35 * w), y), (round(0.65 * w), y), (70, 70, 70), max(h // 40, 4))
    return image


FRONTS: dict[str, Painter] = {f.__name__: f for f in (keyboard, carton, view, panels, drawers)}
