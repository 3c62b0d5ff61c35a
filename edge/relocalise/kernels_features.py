# SPDX-License-Identifier: Apache-2.0
"""Corners of one pyramid level: found, shared out over the image, and turned upright."""

import math

import numpy as np

from edge.kernel import inline_kernel, kernel

# The circle of FAST: 16 pixels at radius 3, clockwise from the top.
_DX = (0, 1, 2, 3, 3, 3, 2, 1, 0, -1, -2, -3, -3, -3, -2, -1)
_DY = (-3, -3, -2, -1, 0, 1, 2, 3, 3, 3, 2, 1, 0, -1, -2, -3)
_ARC = 9  # pixels of the circle in a row that must differ
PATCH_RADIUS = 15  # of the intensity centroid; ORB's own
_MAX_SCORE = 255


def _circle_rows() -> tuple[int, ...]:
    """Half widths of the rows 0 to PATCH_RADIUS of a disc, symmetric in x and y as ORB's."""
    limit = math.floor(PATCH_RADIUS * math.sqrt(2.0) / 2.0 + 1.0)
    widths = [0] * (PATCH_RADIUS + 1)
    for v in range(limit + 1):
        widths[v] = round(math.sqrt(PATCH_RADIUS**2 - v**2))
    smallest = math.ceil(PATCH_RADIUS * math.sqrt(2.0) / 2.0)
    v0 = 0
    for v in range(PATCH_RADIUS, smallest - 1, -1):
        while widths[v0] == widths[v0 + 1]:
            v0 += 1
        widths[v] = v0
        v0 += 1
    return tuple(widths)


_HALF_WIDTH = _circle_rows()


@kernel
def flag_candidates(image, threshold, border, out):  # type: ignore[no-untyped-def]
    """Flag pixels that can be corners: 4 of every second pixel of the circle differ alike.

    image  (h, w)  uint8
    out    (h, w)  uint8, out; 1 where the full test is worth it. The border stays unwritten.
    """
    height, width = image.shape
    t = np.int16(threshold)
    for y in range(border, height - border):
        for x in range(border, width - border):
            centre = np.int16(image[y, x])
            high, low = np.int16(centre + t), np.int16(centre - t)
            a, b = np.int16(image[y - 3, x]), np.int16(image[y - 2, x + 2])
            c, d = np.int16(image[y, x + 3]), np.int16(image[y + 2, x + 2])
            e, f = np.int16(image[y + 3, x]), np.int16(image[y + 2, x - 2])
            g, h = np.int16(image[y, x - 3]), np.int16(image[y - 2, x - 2])
            bright = np.int16(a > high) + np.int16(b > high) + np.int16(c > high)
            bright += np.int16(d > high) + np.int16(e > high) + np.int16(f > high)
            bright += np.int16(g > high) + np.int16(h > high)
            dark = np.int16(a < low) + np.int16(b < low) + np.int16(c < low)
            dark += np.int16(d < low) + np.int16(e < low) + np.int16(f < low)
            dark += np.int16(g < low) + np.int16(h < low)
            out[y, x] = np.uint8((bright >= 4) | (dark >= 4))


@inline_kernel
def _has_arc(mask):  # type: ignore[no-untyped-def]
    """Whether 9 bits in a row, around the end, are set of a 16-bit circle."""
    run = mask | (mask << 16)
    run &= run >> 1
    run &= run >> 2
    run &= run >> 4  # bit k: k to k + 7 are set
    return run & ((mask | (mask << 16)) >> 8) & 0xFFFF != 0


@inline_kernel
def _corner_score(image, y, x, threshold, ring):  # type: ignore[no-untyped-def]
    """Largest threshold [grey] at which (x, y) is still a FAST-9 corner; 0 if none."""
    centre = int(image[y, x])
    bright, dark = 0, 0
    for k in range(16):
        value = int(image[y + _DY[k], x + _DX[k]]) - centre
        ring[k] = value
        bright |= int(value > threshold) << k
        dark |= int(value < -threshold) << k
    sign = 1
    if not _has_arc(bright):
        if not _has_arc(dark):
            return np.int64(0)
        sign = -1
    for k in range(_ARC - 1):
        ring[16 + k] = ring[k]
    best = np.int64(0)
    for start in range(16):
        low = sign * ring[start]
        for k in range(1, _ARC):
            low = min(low, sign * ring[start + k])
        best = max(best, low)
    return best


@kernel
def score_corners(image, flags, threshold, border, ring, out):  # type: ignore[no-untyped-def]
    """Overwrite `out` (h, w) uint8 with FAST scores, 0 where there is no corner.

    flags (h, w) uint8 as `flag_candidates` left them; ring (24,) int64 is scratch.
    """
    height, width = image.shape
    out[:] = 0
    for y in range(border, height - border):
        for x in range(border, width - border):
            if flags[y, x] == 0:
                continue
            score = _corner_score(image, y, x, threshold, ring)
            if score > 0:
                out[y, x] = np.uint8(min(score, _MAX_SCORE))


@kernel
def list_peaks(scores, border, cell, columns, xs, ys, cells, histogram):  # type: ignore[no-untyped-def]
    """List the 3x3 peaks of `scores` in raster order and count them by cell and score.

    scores     (h, w)    uint8
    xs, ys     (n,)      int32, out
    cells      (n,)      int32, out; the cell of `cell` pixels, row by row, `columns` a row
    histogram  (m, 256)  int32, out, added to

    Returns how many were listed; those beyond n are left out.
    """
    height, width = scores.shape
    count = 0
    for y in range(border, height - border):
        for x in range(border, width - border):
            s = scores[y, x]
            if s == 0 or count == xs.shape[0]:
                continue
            # Of equal neighbours the first in raster order is the peak.
            if (
                s > scores[y - 1, x - 1]
                and s > scores[y - 1, x]
                and s > scores[y - 1, x + 1]
                and s > scores[y, x - 1]
                and s >= scores[y, x + 1]
                and s >= scores[y + 1, x - 1]
                and s >= scores[y + 1, x]
                and s >= scores[y + 1, x + 1]
            ):
                index = (y // cell) * columns + x // cell
                xs[count], ys[count], cells[count] = x, y, index
                histogram[index, s] += 1
                count += 1
    return count


@kernel
def share_out(scores, xs, ys, cells, n, histogram, quota, by_rank, chosen):  # type: ignore[no-untyped-def]
    """Choose `quota` corners so that every cell gets its best before any gets its next.

    scores     (h, w)    uint8
    xs ys cells          as `list_peaks` left them, n of them
    histogram  (m, 256)  int32, in: counts; overwritten
    by_rank    (quota + 1, 256)  int32, in: zeros; counts by rank in the cell and score
    chosen     (quota,)  int32, out; indices into xs, ascending

    Returns how many were chosen.
    """
    for c in range(histogram.shape[0]):
        better = 0
        for s in range(_MAX_SCORE, -1, -1):
            here = histogram[c, s]
            histogram[c, s] = better  # rank of the next corner of this cell and score
            better += here
    for i in range(n):
        corner = int(scores[ys[i], xs[i]])
        rank = histogram[cells[i], corner]
        histogram[cells[i], corner] += 1
        cells[i] = min(rank, quota)
        by_rank[cells[i], corner] += 1
    # Everything better than (last_rank, last_score) is in, of that itself the first `spare`.
    taken, last_rank, last_score, spare = 0, quota, -1, 0
    for rank in range(quota):
        for s in range(_MAX_SCORE, -1, -1):
            here = by_rank[rank, s]
            if last_score < 0 and here > 0:
                if taken + here >= quota:
                    last_rank, last_score, spare = rank, s, quota - taken
                taken += here
    count = 0
    for i in range(n):
        corner = int(scores[ys[i], xs[i]])
        keep = cells[i] < last_rank or (cells[i] == last_rank and corner > last_score)
        if cells[i] == last_rank and corner == last_score and spare > 0:
            spare -= 1
            keep = True
        if keep and count < quota:
            chosen[count] = i
            count += 1
    return count


@kernel
def orient(image, xs, ys, out):  # type: ignore[no-untyped-def]
    """Overwrite `out` (n,) float32 with the angle [rad] from each corner to its grey centroid.

    image (h, w) uint8; xs, ys (n,) int32, at least PATCH_RADIUS from the border.
    """
    for i in range(xs.shape[0]):
        x, y = xs[i], ys[i]
        moment_x, moment_y = 0, 0
        for dy in range(-PATCH_RADIUS, PATCH_RADIUS + 1):
            half = _HALF_WIDTH[abs(dy)]
            row_sum, row_moment = 0, 0
            for dx in range(-half, half + 1):
                grey = int(image[y + dy, x + dx])
                row_sum += grey
                row_moment += dx * grey
            moment_x += row_moment
            moment_y += dy * row_sum
        out[i] = np.float32(math.atan2(float(moment_y), float(moment_x)))
