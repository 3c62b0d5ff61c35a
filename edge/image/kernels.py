"""Pixel loops: undistortion, halving, gradients.

Level images are (h, w, 3) float32: grey, and its central differences in x and y
[grey, grey/px]. Borders have gradient zero.
"""

import numpy as np

from edge.kernel import kernel
from edge.types import F32, U8

QUARTER = np.float32(0.25)
HALF = np.float32(0.5)
ONE = np.float32(1.0)


@kernel
def copy_grey(image: U8, out: F32) -> None:
    """Write `image` (h, w) uint8 into channel 0 of `out` (h, w, 3) float32."""
    for y in range(out.shape[0]):
        for x in range(out.shape[1]):
            out[y, x, 0] = np.float32(image[y, x])


@kernel
def halve_grey(image: U8, out: F32) -> None:
    """Write 2x2 means of `image` (2h.., 2w..) uint8 into channel 0 of `out` (h, w, 3)."""
    for y in range(out.shape[0]):
        for x in range(out.shape[1]):
            total = (
                np.int32(image[2 * y, 2 * x])
                + np.int32(image[2 * y, 2 * x + 1])
                + np.int32(image[2 * y + 1, 2 * x])
                + np.int32(image[2 * y + 1, 2 * x + 1])
            )
            out[y, x, 0] = QUARTER * np.float32(total)


@kernel
def halve_level(level: F32, out: F32) -> None:
    """Write 2x2 means of channel 0 of `level` into channel 0 of `out`."""
    for y in range(out.shape[0]):
        for x in range(out.shape[1]):
            out[y, x, 0] = QUARTER * (
                level[2 * y, 2 * x, 0]
                + level[2 * y, 2 * x + 1, 0]
                + level[2 * y + 1, 2 * x, 0]
                + level[2 * y + 1, 2 * x + 1, 0]
            )


@kernel
def differentiate(level: F32) -> None:
    """Fill channels 1 and 2 of `level` (h, w, 3) with central differences of channel 0."""
    height, width = level.shape[0], level.shape[1]
    for y in range(1, height - 1):
        for x in range(1, width - 1):
            level[y, x, 1] = HALF * (level[y, x + 1, 0] - level[y, x - 1, 0])
            level[y, x, 2] = HALF * (level[y + 1, x, 0] - level[y - 1, x, 0])
    for y in range(height):
        level[y, 0, 1] = level[y, 0, 2] = level[y, width - 1, 1] = level[y, width - 1, 2] = 0.0
    for x in range(width):
        level[0, x, 1] = level[0, x, 2] = level[height - 1, x, 1] = level[height - 1, x, 2] = 0.0


@kernel
def undistort(image: U8, map_x: F32, map_y: F32, out: U8) -> None:
    """Resample `image` bilinearly at (map_x, map_y) [px]; pixels with no source become 0.

    image         (h, w)  uint8
    map_x, map_y  (H, W)  float32  where each ideal pixel comes from
    out           (H, W)  uint8, out
    """
    height, width = image.shape
    for y in range(out.shape[0]):
        for x in range(out.shape[1]):
            u, v = map_x[y, x], map_y[y, x]
            inside = (u >= 0.0) and (v >= 0.0) and (u < width - 1) and (v < height - 1)
            if not inside:
                out[y, x] = 0
                continue
            x0, y0 = int(u), int(v)
            a, b = u - np.float32(x0), v - np.float32(y0)
            top = (ONE - a) * np.float32(image[y0, x0]) + a * np.float32(image[y0, x0 + 1])
            low = (ONE - a) * np.float32(image[y0 + 1, x0]) + a * np.float32(image[y0 + 1, x0 + 1])
            out[y, x] = np.uint8((ONE - b) * top + b * low + HALF)


@kernel
def halve_mask(mask: U8, out: U8) -> None:
    """A pixel of `out` is valid where all four of `mask` are."""
    for y in range(out.shape[0]):
        for x in range(out.shape[1]):
            out[y, x] = (
                mask[2 * y, 2 * x]
                & mask[2 * y, 2 * x + 1]
                & mask[2 * y + 1, 2 * x]
                & mask[2 * y + 1, 2 * x + 1]
            )


@kernel
def erode_mask(mask: U8, margin: int, out: U8) -> None:
    """Keep pixels whose square neighbourhood of `margin` px is inside the image and valid."""
    height, width = mask.shape
    for y in range(height):
        for x in range(width):
            out[y, x] = 0
            if x < margin or y < margin or x >= width - margin or y >= height - margin:
                continue
            keep = np.uint8(1)
            for j in range(y - margin, y + margin + 1):
                for i in range(x - margin, x + margin + 1):
                    keep &= mask[j, i]
            out[y, x] = keep
