"""Flat things with something on them: posters, papers, screens, spines, doors."""

from collections.abc import Callable

import cv2
import numpy as np

from tools.simworld.materials import Size, wood
from tools.simworld.noise import U8, Bgr, blend, fractal, tint, to_bytes

LETTERS = "ABCDEFGHIJKLMNOPRSTUVWXYZabdefghijkmnopqrstuvy0123456789&%?!"
FONTS = (cv2.FONT_HERSHEY_SIMPLEX, cv2.FONT_HERSHEY_DUPLEX, cv2.FONT_HERSHEY_COMPLEX,
         cv2.FONT_HERSHEY_TRIPLEX)  # fmt: skip
INK: Bgr = (40, 36, 34)


def _filled(size: Size, colour: Bgr) -> U8:
    return np.full((*size, 3), np.rint(colour), dtype=np.uint8)


def _vivid(rng: np.random.Generator) -> Bgr:
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


def _shape(image: U8, rng: np.random.Generator, reach: float) -> None:
    """One random disc, ring, polygon, bar or triangle fan of up to `reach` pixels."""
    h, w = image.shape[:2]
    x, y = int(rng.integers(0, w)), int(rng.integers(0, h))
    r = int(rng.uniform(0.25, 1.0) * reach)
    colour = _vivid(rng)
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
        cv2.ellipse(image, (x, y), axes, float(rng.uniform(0, 180)), 0, 360, colour, -1, cv2.LINE_AA)


def poster(rng: np.random.Generator, size: Size, colour: Bgr) -> U8:
    """Shapes of many sizes, a headline and small print."""
    h, w = size
    image = _filled(size, colour)
    for reach in (0.4, 0.25, 0.15, 0.08, 0.04):
        for _ in range(round(1.6 / reach)):
            _shape(image, rng, reach * min(h, w))
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
        paint = np.array(_vivid(rng)) * (1.0 - 0.13 * i)
        detail = 1 + (0.08 + 0.06 * i) * fractal(rng, size, (h // 40, w // 40), 5, 0.8)
        layer = tint((paint[0], paint[1], paint[2]), detail)
        image = blend(image, layer, np.clip(rows - ridge, 0, 1))
    done = to_bytes(image)
    for _ in range(14):
        _shape(done, rng, 0.06 * h)
    cv2.rectangle(done, (0, 0), (w - 1, h - 1), colour, round(0.08 * min(h, w)))
    return done


def document(rng: np.random.Generator, size: Size, colour: Bgr) -> U8:
    """A printed sheet: title, paragraphs, a figure."""
    h, w = size
    image = _filled(size, colour)
    margin = round(0.08 * w)
    write_line(image, rng, (margin, round(0.09 * h)), 0.04 * h, w - margin, INK)
    figure = round(rng.uniform(0.2, 0.6) * h)
    body = max(0.02 * h, 6.0)
    write_block(image, rng, (margin, round(0.13 * h), w - margin, figure), body, INK)
    low = figure + round(0.22 * h)
    cv2.rectangle(image, (margin, figure + 4), (w - margin, low), _vivid(rng), -1)
    part = image[figure + 6 : low - 2, margin + 2 : w - margin - 2]
    for _ in range(12):
        _shape(part, rng, 0.12 * h)
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
        cv2.rectangle(image, (x, y), (x1, y + 14), _vivid(rng), -1)
        write_block(image, rng, (x + 6, y + 20, x1, y1 - 4), 8.0, ink)
    cv2.rectangle(image, (0, 0), (w - 1, h - 1), (28, 28, 28), round(0.035 * w))
    return image


def spines(rng: np.random.Generator, size: Size, colour: Bgr) -> U8:
    """A row of book spines of several widths, with titles, bands and shadows between."""
    h, w = size
    image = _filled(size, (colour[0] * 0.2, colour[1] * 0.2, colour[2] * 0.2))
    x = 0
    while x < w - 6:
        width = int(np.clip(rng.normal(0.055, 0.02) * w, 0.025 * w, 0.1 * w))
        top = int(rng.uniform(0.0, 0.22) * h)
        part = image[top:, x : min(x + width, w) - 2]
        part[:] = spine(rng, (h - top, width), _vivid(rng))[:, : part.shape[1]]
        x += width
    return image


def spine(rng: np.random.Generator, size: Size, colour: Bgr) -> U8:
    """One book's back: title along it, bands across it."""
    h, w = size
    image = _filled((w, h), colour)  # lying, turned up in the end
    ink = INK if sum(colour) > 330 else (225.0, 228.0, 230.0)
    band = _vivid(rng)
    for at in rng.uniform(0.03, 0.97, rng.integers(1, 5)):
        cv2.rectangle(image, (round(at * h), 0), (round((at + 0.02) * h), w), band, -1)
    text = max(0.45 * w, 5.0)
    start = round(rng.uniform(0.06, 0.25) * h)
    write_line(image, rng, (start, round(0.5 * w + 0.4 * text)), text, round(0.92 * h), ink)
    return np.ascontiguousarray(np.rot90(image, 3))


def keyboard(rng: np.random.Generator, size: Size, colour: Bgr) -> U8:
    """Rows of keys with letters."""
    h, w = size
    image = _filled(size, colour)
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
    done = to_bytes(blend(image, tint((165, 160, 160), 1 + 0.1 * fractal(rng, size, (9, 9), 4)), below))
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


def notes(rng: np.random.Generator, size: Size, colour: Bgr) -> U8:
    """A pin board covered with sheets, cards and photographs."""
    h, w = size
    image = to_bytes(tint(colour, 1 + 0.12 * fractal(rng, size, (h // 6, w // 6), 3, 0.9)))
    for _ in range(16):
        sh = int(rng.uniform(0.14, 0.36) * h)
        sw = int(sh * rng.uniform(0.65, 1.2))
        y, x = int(rng.uniform(0.02, 0.98) * (h - sh)), int(rng.uniform(0.02, 0.98) * (w - sw))
        paint = (235.0, 236.0, 236.0) if rng.random() < 0.5 else _vivid(rng)
        sheet = (document if rng.random() < 0.6 else poster)(rng, (sh, sw), paint)
        image[y : y + sh, x : x + sw] = sheet[: h - y, : w - x]
        cv2.circle(image, (x + sw // 2, y + 6), 4, (40, 40, 200), -1, cv2.LINE_AA)
    return image


PICTURES: dict[str, Callable[[np.random.Generator, Size, Bgr], U8]] = {
    f.__name__: f
    for f in (
        poster, photograph, document, whiteboard, screen, spines, spine, keyboard, carton, view,
        panels, drawers, notes,
    )
}
