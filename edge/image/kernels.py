# SPDX-License-Identifier: Apache-2.0
"""Pixel loops: undistortion, halving, noise, gradients.

Level images are (h, w, 3) float32: grey, and its central differences in x and y
[grey, grey/px]. Borders have gradient zero.
"""

import numpy as np

from edge.kernel import kernel
from edge.types import F32, I32, U8

ZERO = np.float32(0.0)
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
def brighten(level: F32, gain: F32) -> None:
    """Multiply channel 0 of `level` (h, w, 3) by `gain` (h, w) float32."""
    for y in range(level.shape[0]):
        for x in range(level.shape[1]):
            level[y, x, 0] *= gain[y, x]


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
def count_roughness(image: U8, step: int, counts: I32) -> None:
    """Histogram of what is left of `image` (h, w) uint8 where all smooth shades cancel out.

    At every `step`-th pixel of every `step`-th row: |second difference in x of that in y|
    (Immerkaer, "Fast noise variance estimation", 1996), in `counts` (n,) int32; larger ones in
    the last. Pixels at an end of the scale say nothing of noise and are left out.
    """
    counts[:] = 0
    for y in range(1, image.shape[0] - 1, step):
        for x in range(1, image.shape[1] - 1, step):
            here = int(image[y, x])
            if here == 0 or here == 255:
                continue
            rough = 4 * here
            for d in (-1, 1):
                rough -= 2 * (int(image[y, x + d]) + int(image[y + d, x]))
                rough += int(image[y + d, x - 1]) + int(image[y + d, x + 1])
            counts[min(abs(rough), len(counts) - 1)] += 1


@kernel
def smooth(level: F32, share: np.float32, rows: F32) -> None:
    """Move channel 0 of `level` (h, w, 3) by `share` to its binomial mean over 3x3 pixels.

    `rows` (3, w) float32 is scratch. The outermost pixels stay.
    """
    height, width = level.shape[0], level.shape[1]
    for y in range(height):
        newest = rows[y % 3]
        for x in range(1, width - 1):
            newest[x] = QUARTER * (level[y, x - 1, 0] + level[y, x + 1, 0]) + HALF * level[y, x, 0]
        if y < 2:
            continue
        oldest, middle = rows[(y - 2) % 3], rows[(y - 1) % 3]
        for x in range(1, width - 1):
            mean = QUARTER * (oldest[x] + newest[x]) + HALF * middle[x]
            level[y - 1, x, 0] += share * (mean - level[y - 1, x, 0])


@kernel
def undistort(image: U8, maps: F32, turn: F32, intrinsics: F32, scratch: F32, out: F32) -> None:
    """Resample `image` bilinearly where `maps` says; pixels with no source become 0.

    image         (h, w)     uint8
    maps          (H, W, 2)  float32  where each ideal pixel comes from: x, y [px]
    turn          (3,)       float32  how far the camera turned while its rows were read [rad]:
                                      each row becomes what the middle one would have seen
    intrinsics    (4,)       float32  fx fy cx cy of the ideal image
    scratch       (h * w + 3 * W,)  float32
    out           (H, W, 3)  float32  its channel 0 is written
    """
    height, width = image.shape
    flat = image.reshape(-1)
    grey = scratch[: height * width]
    for k in range(height * width):
        grey[k] = np.float32(flat[k])
    columns = out.shape[1]
    sources = scratch[height * width : height * width + 2 * columns]
    values = scratch[height * width + 2 * columns :]
    for i in range(out.shape[0]):
        # The map's slopes, taken between neighbours: from i, j to below and beside.
        below = min(i + 1, out.shape[0] - 1)
        y = (np.float32(i) - intrinsics[3]) / intrinsics[1]
        here, next_row = maps[i].reshape(-1), maps[below].reshape(-1)
        _row_sources(here, next_row, columns, height, y, turn, intrinsics, sources)
        _sample_row(grey, height, width, sources, values)
        for j in range(columns):
            out[i, j, 0] = values[j]


@kernel
def _row_sources(
    here: F32,
    below: F32,
    n: int,
    height: int,
    y: np.float32,
    turn: F32,
    intrinsics: F32,
    sources: F32,
) -> None:
    """Where the pixels of one row come from, the turn while reading taken into account."""
    fx, fy, cx = intrinsics[0], intrinsics[1], intrinsics[2]
    ifx, tall = ONE / fx, ONE / np.float32(height)
    wx, wy, wz = turn[0], turn[1], turn[2]
    for j in range(n - 1):
        x = (np.float32(np.int32(j)) - cx) * ifx
        u, v = here[2 * j], here[2 * j + 1]
        late = v * tall - HALF
        spin = wx * y - wy * x
        dj = late * fx * (wz * y - wy + x * spin)
        di = late * fy * (wx - wz * x + y * spin)
        sources[2 * j] = u + dj * (here[2 * j + 2] - u) + di * (below[2 * j] - u)
        sources[2 * j + 1] = v + dj * (here[2 * j + 3] - v) + di * (below[2 * j + 1] - v)
    # The last column lies in no mask.
    sources[2 * n - 2], sources[2 * n - 1] = here[2 * n - 2], here[2 * n - 1]


@kernel
def _sample_row(grey: F32, height: int, width: int, sources: F32, values: F32) -> None:
    """Bilinear samples of grey (height * width,) at the sources (n, 2), flat."""
    u_max, v_max = np.float32(width - 1), np.float32(height - 1)
    w = np.int32(width)
    for j in range(values.shape[0]):
        u, v = sources[2 * j], sources[2 * j + 1]
        inside = (u >= ZERO) & (v >= ZERO) & (u < u_max) & (v < v_max)
        u = u if inside else ZERO
        v = v if inside else ZERO
        x0, y0 = np.int32(u), np.int32(v)
        a, b = u - np.float32(x0), v - np.float32(y0)
        at = y0 * w + x0
        first, second = grey[at], grey[at + np.int32(1)]
        third, fourth = grey[at + w], grey[at + w + np.int32(1)]
        top = first + a * (second - first)
        low = third + a * (fourth - third)
        value = top + b * (low - top)
        values[j] = value if inside else ZERO


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
