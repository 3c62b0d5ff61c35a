# SPDX-License-Identifier: Apache-2.0
"""Flat things with something to read on them: posters, papers, screens, spines."""

import cv2
import numpy as np

from edge.types import U8
from tools.simworld.drawing import INK, add_shape, filled, vivid, write_block, write_line
from tools.simworld.materials import Painter, Size
from tools.simworld.noise import Bgr, blend, fractal, tint, to_bytes


def poster(rng: np.random.Generator, size: Size, colour: Bgr) -> U8:
    """Shapes of many sizes, a headline and small print."""
    h, w = size
    image = filled(size, colour)
    for reach in (0.4, 0.25, 0.15, 0.08, 0.04):
        for _ in range(round(1.6 / reach)):
            add_shape(image, rng, reach * min(h, w))
    ink = INK if sum(colour) > 330 else (235.0, 238.0, 240.0)
    top = int(rng.uniform(0.08, 0.8) * h)
    cv2.rectangle(image, (0, top), (w, top + round(0.13 * h)), colour, -1)
    write_line(image, rng, (round(0.06 * w), top + round(0.1 * h)), 0.075 * h, w, ink)
    left = int(rng.uniform(0.05, 0.5) * w)
    box = (left, round(0.86 * h), left + round(0.45 * w), round(0.97 * h))
    write_block(image, rng, box, max(0.018 * h, 6.0), ink)
    return image


def photograph(rng: np.random.Generator, size: Size, colour: Bgr) -> U8:
    """A landscape: sky, ridges one behind the other, ground with boulders; white mat."""
    h, w = size
    sky = tint((225, 190, 150), 1 + 0.12 * fractal(rng, size, (3, 4), 6))
    image = sky
    rows = np.arange(h, dtype=np.float32)[:, None]
    for i in range(5):
        ridge = h * (0.25 + 0.15 * i) + 0.08 * h * fractal(rng, (8, w), (1, 3 + 2 * i), 6, 0.5)[:1]
        paint = np.array(vivid(rng)) * (1.0 - 0.13 * i)
        detail = 1 + (0.08 + 0.06 * i) * fractal(rng, size, (h // 40, w // 40), 5, 0.8)
        layer = tint((paint[0], paint[1], paint[2]), detail)
        image = blend(image, layer, np.clip(rows - ridge, 0, 1))
    done = to_bytes(image)
    for _ in range(14):
        add_shape(done, rng, 0.06 * h)
    cv2.rectangle(done, (0, 0), (w - 1, h - 1), colour, round(0.08 * min(h, w)))
    return done


def document(rng: np.random.Generator, size: Size, colour: Bgr) -> U8:
    """A printed sheet: title, paragraphs, a figure."""
    h, w = size
    image = filled(size, colour)
    margin = round(0.08 * w)
    write_line(image, rng, (margin, round(0.09 * h)), 0.04 * h, w - margin, INK)
    figure = round(rng.uniform(0.2, 0.6) * h)
    body = max(0.02 * h, 6.0)
    write_block(image, rng, (margin, round(0.13 * h), w - margin, figure), body, INK)
    low = figure + round(0.22 * h)
    cv2.rectangle(image, (margin, figure + 4), (w - margin, low), vivid(rng), -1)
    part = image[figure + 6 : low - 2, margin + 2 : w - margin - 2]
    for _ in range(12):
        add_shape(part, rng, 0.12 * h)
    write_block(image, rng, (margin, low + 4, w - margin, round(0.95 * h)), body, INK)
    return image


def whiteboard(rng: np.random.Generator, size: Size, colour: Bgr) -> U8:
    """Scribbles, boxes, arrows and a few curves in marker colours on white."""
    h, w = size
    image = to_bytes(tint(colour, 1 + 0.01 * fractal(rng, size, (3, 3), 4)))
    pens: tuple[Bgr, ...] = ((60, 50, 45), (150, 60, 50), (60, 55, 170), (70, 120, 50))
    for _ in range(9):
        pen = pens[rng.integers(0, 4)]
        x, y = int(rng.uniform(0.03, 0.7) * w), int(rng.uniform(0.05, 0.75) * h)
        kind = rng.integers(0, 3)
        if kind == 0:
            box = (x, y, x + int(0.3 * w), y + int(rng.uniform(0.1, 0.25) * h))
            write_block(image, rng, box, 0.04 * h, pen)
        elif kind == 1:
            x1, y1 = x + int(0.18 * w), y + int(0.14 * h)
            cv2.rectangle(image, (x, y), (x1, y1), pen, 3, cv2.LINE_AA)
            write_line(image, rng, (x + 8, y + int(0.09 * h)), 0.04 * h, x1, pen)
            far = (x1 + int(0.1 * w), int(rng.uniform(0.1, 0.9) * h))
            cv2.arrowedLine(image, (x1, y), far, pen, 3, cv2.LINE_AA)
        else:
            t = np.linspace(0, 0.25 * w, 60)
            curve = y + 0.1 * h * fractal(rng, (8, 60), (1, 3), 3)[0]
            points = np.rint(np.stack([x + t, curve], axis=1)).astype(np.int32)
            cv2.polylines(image, [points], False, pen, 3, cv2.LINE_AA)
    return image


def screen(rng: np.random.Generator, size: Size, colour: Bgr) -> U8:
    """A desktop with overlapping windows of text and pictures, in a dark bezel."""
    h, w = size
    image = to_bytes(tint(colour, 1 + 0.2 * fractal(rng, size, (2, 3), 5)))
    for _ in range(4):
        x, y = int(rng.uniform(0.02, 0.5) * w), int(rng.uniform(0.03, 0.45) * h)
        x1, y1 = x + int(rng.uniform(0.3, 0.48) * w), y + int(rng.uniform(0.3, 0.5) * h)
        dark = rng.random() < 0.5
        back, ink = ((46, 40, 38), (190, 215, 205)) if dark else ((236, 238, 240), INK)
        cv2.rectangle(image, (x, y), (x1, y1), back, -1)
        cv2.rectangle(image, (x, y), (x1, y + 14), vivid(rng), -1)
        write_block(image, rng, (x + 6, y + 20, x1, y1 - 4), 8.0, ink)
    cv2.rectangle(image, (0, 0), (w - 1, h - 1), (28, 28, 28), round(0.035 * w))
    return image


def spines(rng: np.random.Generator, size: Size, colour: Bgr) -> U8:
    """A row of book spines of several widths, with titles, bands and shadows between."""
    h, w = size
    image = filled(size, (colour[0] * 0.2, colour[1] * 0.2, colour[2] * 0.2))
    x = 0
    while x < w - 6:
        width = int(np.clip(rng.normal(0.055, 0.02) * w, 0.025 * w, 0.1 * w))
        top = int(rng.uniform(0.0, 0.22) * h)
        part = image[top:, x : min(x + width, w) - 2]
        part[:] = spine(rng, (h - top, width), vivid(rng))[:, : part.shape[1]]
        x += width
    return image


def spine(rng: np.random.Generator, size: Size, colour: Bgr) -> U8:
    """One book's back: title along it, bands across it."""
    h, w = size
    image = filled((w, h), colour)  # lying, turned up in the end
    ink = INK if sum(colour) > 330 else (225.0, 228.0, 230.0)
    band = vivid(rng)
    for at in rng.uniform(0.03, 0.97, rng.integers(1, 5)):
        cv2.rectangle(image, (round(at * h), 0), (round((at + 0.02) * h), w), band, -1)
    text = max(0.45 * w, 5.0)
    start = round(rng.uniform(0.06, 0.25) * h)
    write_line(image, rng, (start, round(0.5 * w + 0.4 * text)), text, round(0.92 * h), ink)
    return np.ascontiguousarray(np.rot90(image, 3))


def notes(rng: np.random.Generator, size: Size, colour: Bgr) -> U8:
    """A pin board covered with sheets, cards and photographs."""
    h, w = size
    image = to_bytes(tint(colour, 1 + 0.12 * fractal(rng, size, (h // 6, w // 6), 3, 0.9)))
    for _ in range(16):
        sh = int(rng.uniform(0.14, 0.36) * h)
        sw = int(sh * rng.uniform(0.65, 1.2))
        y, x = int(rng.uniform(0.02, 0.98) * (h - sh)), int(rng.uniform(0.02, 0.98) * (w - sw))
        paint = (235.0, 236.0, 236.0) if rng.random() < 0.5 else vivid(rng)
        sheet = (document if rng.random() < 0.6 else poster)(rng, (sh, sw), paint)
        image[y : y + sh, x : x + sw] = sheet[: h - y, : w - x]
        cv2.circle(image, (x + sw // 2, y + 6), 4, (70, 70, 190), -1, cv2.LINE_AA)
    return image


PICTURES: dict[str, Painter] = {
    f.__name__: f for f in (poster, photograph, document, whiteboard, screen, spines, spine, notes)
}
