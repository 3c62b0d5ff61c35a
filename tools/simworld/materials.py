# SPDX-License-Identifier: Apache-2.0
"""Procedural surfaces: what walls, floors and furniture are made of. All wrap around."""

from collections.abc import Callable
from typing import TypeAlias

import cv2
import numpy as np

from edge.types import F32, F64, I32, U8
from tools.simworld.noise import Bgr, blend, fractal, tint, to_bytes, value_noise

Size = tuple[int, int]  # (h, w) [px]


def plain(rng: np.random.Generator, size: Size, colour: Bgr) -> U8:
    """Smooth paint: hardly anything to see."""
    return to_bytes(tint(colour, 1.0 + 0.006 * fractal(rng, size, (2, 2), 3)))


def uniform(rng: np.random.Generator, size: Size, colour: Bgr) -> U8:
    """One colour and nothing else."""
    return to_bytes(np.full((*size, 3), colour, np.float32))


def plaster(rng: np.random.Generator, size: Size, colour: Bgr) -> U8:
    """Rough wall paint with stains and small dents."""
    h, w = size
    coarse = fractal(rng, size, (3, 3), 4)
    fine = fractal(rng, size, (h // 12, w // 12), 3, 0.7)
    dents = np.clip(fine - 1.2, 0.0, 1.0)
    return to_bytes(tint(colour, 1.0 + 0.05 * coarse + 0.035 * fine - 0.22 * dents))


def _courses(size: Size, rows: int, cols: int) -> tuple[I32, I32, F32, F32]:
    """Running bond: row and column numbers (h, w), and place inside a brick in [0, 1]."""
    y, x = np.mgrid[0 : size[0], 0 : size[1]].astype(np.float32) + np.float32(0.5)
    y *= np.float32(rows / size[0])
    row = np.floor(y).astype(np.int32)
    x = x * np.float32(cols / size[1]) + np.float32(0.5) * (row % 2)
    col = np.floor(x).astype(np.int32)
    return row, col % cols, (y - row).astype(np.float32), (x - col).astype(np.float32)


def brick(rng: np.random.Generator, size: Size, colour: Bgr) -> U8:
    """Brickwork, 32 courses high; each brick has its own shade and flaws."""
    rows, cols = 32, max(2, 2 * round(8 * size[1] / size[0]))
    r, c, y, x = _courses(size, rows, cols)
    shade = rng.normal(1.0, 0.13, (rows, cols)).astype(np.float32)
    warm = rng.normal(0.0, 9.0, (rows, cols)).astype(np.float32)
    fine = fractal(rng, size, (size[0] // 10, size[1] // 10), 3, 0.7)
    face = tint(colour, shade[r, c] * (1.0 + 0.09 * fine))
    face[:, :, 2] += warm[r, c]
    wobble = 0.35 * value_noise(rng, size, (3 * rows, 3 * cols))
    # distance to the joint in units of a course's height; a brick is about 3 courses long
    gap = np.minimum(np.minimum(y, 1 - y), 3.2 * np.minimum(x, 1 - x)) * 10.0 + wobble
    inside = np.clip(gap - 0.5, 0.0, 1.0)
    mortar = tint((150, 156, 160), 1.0 + 0.08 * fine)
    return to_bytes(blend(mortar, face, inside))


def wood(rng: np.random.Generator, size: Size, colour: Bgr) -> U8:
    """A wooden board, grain along u."""
    h, w = size
    bend = fractal(rng, size, (2, 2), 3)
    phase = np.linspace(0, 14 * 2 * np.pi, h, endpoint=False, dtype=np.float32)[:, None]
    rings = np.sin(phase + 2.4 * bend)
    fibre = value_noise(rng, size, (h // 3, max(w // 64, 2)))
    pores = np.clip(value_noise(rng, size, (h // 4, w // 24)) - 0.62, 0, 1)
    tone = 1.0 + 0.10 * rings + 0.07 * fibre - 0.9 * pores + 0.05 * bend
    return to_bytes(tint(colour, tone))


def planks(rng: np.random.Generator, size: Size, colour: Bgr) -> U8:
    """A wooden floor of planks along u."""
    h, w = size
    rows = max(h // 64, 4)
    r, c, y, x = _courses(size, rows - rows % 2, 3)
    grain = wood(rng, size, colour).astype(np.float32)
    shade = rng.normal(1.0, 0.10, (rows, 3)).astype(np.float32)
    shift = rng.integers(0, w, (rows, 3))
    u = (np.arange(w)[None, :] + shift[r, c]) % w
    board = grain[np.arange(h)[:, None], u] * shade[r, c][:, :, None]
    gap = np.minimum(np.minimum(y, 1 - y) * 64.0, np.minimum(x, 1 - x) * w / 3.0)
    return to_bytes(board * (0.35 + 0.65 * np.clip(gap - 0.5, 0.0, 1.0))[:, :, None])


def carpet(rng: np.random.Generator, size: Size, colour: Bgr) -> U8:
    """Short loops with flecks of two other colours and some wear."""
    h, w = size
    loops = value_noise(rng, size, (h // 3, w // 3))
    flecks = fractal(rng, size, (h // 14, w // 14), 2, 0.8)
    wear = fractal(rng, size, (4, 4), 4)
    base = tint(colour, 1.0 + 0.13 * loops + 0.06 * wear)
    light = tuple(min(255.0, 1.5 * c + 25) for c in colour)
    dark = tuple(0.5 * c for c in colour)
    base = blend(base, tint((light[0], light[1], light[2]), 1 + 0.1 * loops), _step(flecks, 1.1))
    base = blend(base, tint((dark[0], dark[1], dark[2]), 1 + 0.1 * loops), _step(-flecks, 1.0))
    return to_bytes(base)


def _step(x: F32, at: float) -> F32:
    """0 below `at`, 1 above, with a soft edge."""
    return np.asarray(np.clip(4.0 * (x - at) + 0.5, 0.0, 1.0), np.float32)


def stripes(rng: np.random.Generator, size: Size, colour: Bgr) -> U8:
    """A woven rug: irregular stripes along u, broken by blocks."""
    h, w = size
    edges = np.sort(rng.choice(h // 8, h // 32, replace=False)) * 8
    which = np.searchsorted(edges, np.arange(h))
    palette = rng.uniform(0.35, 1.5, (which.max() + 1, 1)) * np.array(colour)
    palette += rng.normal(0, 14, palette.shape)
    block = value_noise(rng, size, (h // 32, w // 24)) > 0.45
    image = np.broadcast_to(palette[which][:, None, :], (h, w, 3)).astype(np.float32)
    image = np.where(block[:, :, None], image[::-1], image)
    return to_bytes(image * (1 + 0.12 * value_noise(rng, size, (h // 2, w // 2)))[:, :, None])


def terrazzo(rng: np.random.Generator, size: Size, colour: Bgr) -> U8:
    """Stone chips of many sizes in cement."""
    h, w = size
    image = to_bytes(tint(colour, 1 + 0.04 * fractal(rng, size, (h // 8, w // 8), 3)))
    for _ in range(h * w // 420):
        x, y = rng.integers(0, w), rng.integers(0, h)
        radius = float(np.clip(rng.lognormal(1.25, 0.5), 2.0, 14.0))
        angles = np.sort(rng.uniform(0, 2 * np.pi, 6))
        shape = radius * np.stack([np.cos(angles), rng.uniform(0.5, 1) * np.sin(angles)], axis=1)
        paint = np.array(colour) * rng.uniform(0.35, 1.35) + rng.normal(0, 16, 3)
        for dx in (-w, 0, w):  # wraps around where it leaves an edge
            if -20 < x + dx < w + 20:
                corners = np.rint((shape + np.array([x + dx, y])) * 16).astype(np.int32)
                cv2.fillPoly(image, [corners], _clip(paint), cv2.LINE_AA, 4)
    return image


def _clip(colour: F64) -> tuple[float, ...]:
    return tuple(float(c) for c in np.clip(colour, 0, 255))


def tiles(rng: np.random.Generator, size: Size, colour: Bgr) -> U8:
    """Square tiles with light joints; some are of another shade."""
    h, w = size
    rows, cols = 16, max(2, round(16 * w / h))
    v = (np.arange(h, dtype=np.float32) + 0.5) * rows / h
    u = (np.arange(w, dtype=np.float32) + 0.5) * cols / w
    r, c = np.floor(v).astype(np.int32), np.floor(u).astype(np.int32)
    shade = rng.normal(1.0, 0.06, (rows, cols)) * np.where(rng.random((rows, cols)) < 0.14, 0.6, 1)
    y, x = (v % 1)[:, None], (u % 1)[None, :]
    gap = np.minimum(np.minimum(y, 1 - y), np.minimum(x, 1 - x)) * (h / rows)
    glaze = shade[r][:, c].astype(np.float32) * (1 + 0.025 * fractal(rng, size, (24, 24), 4))
    joint = tint((190, 195, 198), 1 + 0.05 * value_noise(rng, size, (h // 4, w // 4)))
    return to_bytes(blend(joint, tint(colour, glaze), np.clip(gap - 1.0, 0.0, 1.0)))


def checker(rng: np.random.Generator, size: Size, colour: Bgr) -> U8:
    """Linoleum squares in two shades with marbling."""
    h, w = size
    v, u = np.arange(h) * 8 // h, np.arange(w) * 8 // w
    odd = ((v[:, None] + u[None, :]) % 2).astype(np.float32)
    marble = fractal(rng, size, (6, 6), 6, 0.7)
    dark = tint((0.45 * colour[0], 0.45 * colour[1], 0.45 * colour[2]), 1 + 0.12 * marble)
    return to_bytes(blend(dark, tint(colour, 1 + 0.06 * marble), odd))


def fabric(rng: np.random.Generator, size: Size, colour: Bgr) -> U8:
    """Upholstery: weave with melange yarn."""
    h, w = size
    weave = value_noise(rng, size, (h // 2, w // 8)) + value_noise(rng, size, (h // 8, w // 2))
    return to_bytes(tint(colour, 1 + 0.11 * weave + 0.05 * fractal(rng, size, (4, 4), 3)))


def leaves(rng: np.random.Generator, size: Size, colour: Bgr) -> U8:
    """Foliage: bright tips over dark gaps."""
    h, w = size
    a = fractal(rng, size, (h // 24, w // 24), 4, 0.7)
    return to_bytes(tint(colour, 0.75 + 0.35 * np.clip(a, -1.6, 1.6)))


def speckle(rng: np.random.Generator, size: Size, colour: Bgr) -> U8:
    """Granite or cork: grain at every scale."""
    h, w = size
    a = fractal(rng, size, (h // 24, w // 24), 4, 0.9)
    spots = _step(fractal(rng, size, (h // 10, w // 10), 2), 1.3)
    return to_bytes(tint(colour, (1 + 0.13 * a) * (1 - 0.45 * spots)))


Painter: TypeAlias = Callable[[np.random.Generator, Size, Bgr], U8]
MATERIALS: dict[str, Painter] = {
    f.__name__: f
    for f in (
        plain,
        uniform,
        plaster,
        brick,
        wood,
        planks,
        carpet,
        stripes,
        terrazzo,
        tiles,
        checker,
        fabric,
        leaves,
        speckle,
    )
}
