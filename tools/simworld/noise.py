# SPDX-License-Identifier: Apache-2.0
"""Periodic value noise, the stuff of most materials."""

from typing import TypeAlias

import cv2
import numpy as np

from edge.types import F32, F64, U8

Bgr: TypeAlias = tuple[float, float, float]  # [0, 255]


def value_noise(rng: np.random.Generator, size: tuple[int, int], cells: tuple[int, int]) -> F32:
    """One octave (h, w) float32 in about [-1, 1] that wraps around on both axes."""
    h, w = size
    rows, cols = min(max(cells[0], 1), h), min(max(cells[1], 1), w)
    grid = rng.uniform(-1.0, 1.0, (rows, cols)).astype(np.float32)
    pad = 2  # what the cubic kernel reaches
    sy, sx = h / rows, w / cols
    grid = np.pad(grid, pad, mode="wrap")
    M = np.array([[1 / sx, 0, pad - 0.5 + 0.5 / sx], [0, 1 / sy, pad - 0.5 + 0.5 / sy]])
    flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    return np.asarray(cv2.warpAffine(grid, M, (w, h), flags=flags), np.float32)


def fractal(
    rng: np.random.Generator,
    size: tuple[int, int],
    cells: tuple[int, int],
    octaves: int = 5,
    gain: float = 0.55,
) -> F32:
    """Sum of octaves (h, w) float32, each twice as fine and `gain` as strong; unit deviation."""
    total = np.zeros(size, dtype=np.float32)
    rows, cols = cells
    weight = 1.0
    for _ in range(octaves):
        total += np.float32(weight) * value_noise(rng, size, (rows, cols))
        weight *= gain
        rows, cols = 2 * rows, 2 * cols
        if rows > size[0] and cols > size[1]:
            break
    return np.asarray((total - total.mean()) / (total.std() + 1e-9), np.float32)


def tint(colour: Bgr, brightness: F32) -> F32:
    """`colour` times a brightness map (h, w), as (h, w, 3) float32."""
    return np.asarray(brightness[:, :, None] * np.array(colour, dtype=np.float32), np.float32)


def blend(a: F32, b: F32, share: F32 | F64) -> F32:
    """(1 - share) a + share b with `share` (h, w)."""
    return a + share.astype(np.float32)[:, :, None] * (b - a)


def to_bytes(image: F32) -> U8:
    """Rounded and clipped to [0, 255]."""
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)
