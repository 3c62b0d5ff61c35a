# SPDX-License-Identifier: Apache-2.0
"""Corners of one pyramid level: found, shared out over the image, and turned upright."""

import math

import numpy as np

from edge.kernel import inline_kernel, kernel

# ORB's rotated pattern reaches 18.4 pixels; nearer to the border it would see a mirror image.
BORDER_PX = 19
PATCH_RADIUS = 15  # of the intensity centroid; ORB's own
_MAX_SCORE = 255
_1, _2, _3 = np.uint64(1), np.uint64(2), np.uint64(3)


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


@inline_kernel
def _best_arc(p0, p1, p2, p3, p4, p5, p6, p7, p8, p9, p10, p11, p12, p13, p14, p15):  # type: ignore[no-untyped-def]
    """Of all 9 in a row on a circle of 16, the largest minimum: minima of 2, 4, 8, then 9."""
    a0 = min(p0, p1)
    a1 = min(p1, p2)
    a2 = min(p2, p3)
    a3 = min(p3, p4)
    a4 = min(p4, p5)
    a5 = min(p5, p6)
    a6 = min(p6, p7)
    a7 = min(p7, p8)
    a8 = min(p8, p9)
    a9 = min(p9, p10)
    a10 = min(p10, p11)
    a11 = min(p11, p12)
    a12 = min(p12, p13)
    a13 = min(p13, p14)
    a14 = min(p14, p15)
    a15 = min(p15, p0)
    b0 = min(a0, a2)
    b1 = min(a1, a3)
    b2 = min(a2, a4)
    b3 = min(a3, a5)
    b4 = min(a4, a6)
    b5 = min(a5, a7)
    b6 = min(a6, a8)
    b7 = min(a7, a9)
    b8 = min(a8, a10)
    b9 = min(a9, a11)
    b10 = min(a10, a12)
    b11 = min(a11, a13)
    b12 = min(a12, a14)
    b13 = min(a13, a15)
    b14 = min(a14, a0)
    b15 = min(a15, a1)
    best = min(min(b0, b4), p8)
    best = max(best, min(min(b1, b5), p9))
    best = max(best, min(min(b2, b6), p10))
    best = max(best, min(min(b3, b7), p11))
    best = max(best, min(min(b4, b8), p12))
    best = max(best, min(min(b5, b9), p13))
    best = max(best, min(min(b6, b10), p14))
    best = max(best, min(min(b7, b11), p15))
    best = max(best, min(min(b8, b12), p0))
    best = max(best, min(min(b9, b13), p1))
    best = max(best, min(min(b10, b14), p2))
    best = max(best, min(min(b11, b15), p3))
    best = max(best, min(min(b12, b0), p4))
    best = max(best, min(min(b13, b1), p5))
    best = max(best, min(min(b14, b2), p6))
    return max(best, min(min(b15, b3), p7))


@inline_kernel
def _above(a, b):  # type: ignore[no-untyped-def]
    """Difference a - b of two uint8, 0 where that is negative."""
    return np.uint8(max(a, b) - b)


@kernel
def score_corners(image, height, width, out):  # type: ignore[no-untyped-def]
    """Overwrite `out` with FAST-9 scores: the largest threshold at which it is still a corner.

    Of the 16 pixels at radius 3, 9 in a row must all be brighter or all darker by more than it.
    Without a branch, in bytes, and with unsigned indices it runs over 64 pixels at once: signed
    ones may be negative and wrap around, which no vector load can.

    image  (height * width,)  uint8
    out    (height * width,)  uint8, out; 0 in the border
    """
    w1 = np.uint64(width)
    w2, w3 = w1 + w1, w1 + w1 + w1
    out[:] = 0
    for y in range(BORDER_PX, height - BORDER_PX):
        start = np.uint64(y * width + BORDER_PX)
        for k in range(width - 2 * BORDER_PX):
            at = start + np.uint64(k)
            c = image[at]
            p0 = image[at - w3]
            p1 = image[at - w3 + _1]
            p2 = image[at - w2 + _2]
            p3 = image[at - w1 + _3]
            p4 = image[at + _3]
            p5 = image[at + w1 + _3]
            p6 = image[at + w2 + _2]
            p7 = image[at + w3 + _1]
            p8 = image[at + w3]
            p9 = image[at + w3 - _1]
            p10 = image[at + w2 - _2]
            p11 = image[at + w1 - _3]
            p12 = image[at - _3]
            p13 = image[at - w1 - _3]
            p14 = image[at - w2 - _2]
            p15 = image[at - w3 - _1]
            bright = _best_arc(
                _above(p0, c),
                _above(p1, c),
                _above(p2, c),
                _above(p3, c),
                _above(p4, c),
                _above(p5, c),
                _above(p6, c),
                _above(p7, c),
                _above(p8, c),
                _above(p9, c),
                _above(p10, c),
                _above(p11, c),
                _above(p12, c),
                _above(p13, c),
                _above(p14, c),
                _above(p15, c),
            )
            dark = _best_arc(
                _above(c, p0),
                _above(c, p1),
                _above(c, p2),
                _above(c, p3),
                _above(c, p4),
                _above(c, p5),
                _above(c, p6),
                _above(c, p7),
                _above(c, p8),
                _above(c, p9),
                _above(c, p10),
                _above(c, p11),
                _above(c, p12),
                _above(c, p13),
                _above(c, p14),
                _above(c, p15),
            )
            out[at] = max(bright, dark)


@kernel
def mark_peaks(scores, height, width, threshold, peaks):  # type: ignore[no-untyped-def]
    """Write 1 into `peaks` for each 3x3 peak above `threshold`; the border is left as it is.

    Of equal neighbours the first in raster order is the peak. Without a branch, as above.

    scores  (height * width,)  uint8
    peaks   (n,)               uint8, out; n at least height * width
    """
    w1 = np.uint64(width)
    for y in range(BORDER_PX, height - BORDER_PX):
        start = np.uint64(y * width + BORDER_PX)
        for k in range(width - 2 * BORDER_PX):
            at = start + np.uint64(k)
            s = scores[at]
            above = max(max(scores[at - w1 - _1], scores[at - w1]), scores[at - w1 + _1])
            below = max(max(scores[at + w1 - _1], scores[at + w1]), scores[at + w1 + _1])
            before = max(max(above, scores[at - _1]), threshold)
            after = max(below, scores[at + _1])
            peaks[at] = np.uint8(s > before) & np.uint8(s >= after)


@kernel
def list_peaks(scores, width, eights, cell, columns, xs, ys, cells, histogram):  # type: ignore[no-untyped-def]
    """List the marked peaks in raster order; count them by cell and score.

    scores     (height * width,)  uint8
    eights     (n,)      uint64, what `mark_peaks` wrote, eight pixels each: most have none
    xs, ys     (n,)      int32, out
    cells      (n,)      int32, out; the cell of `cell` pixels, row by row, `columns` a row
    histogram  (m, 256)  int32, out, added to

    Returns how many were listed; those beyond n are left out.
    """
    marks = eights.view(np.uint8)
    count = 0
    for eight in range(eights.shape[0]):
        if eights[eight] == 0:
            continue
        for at in range(8 * eight, 8 * eight + 8):
            if marks[at] == 0 or count == xs.shape[0]:
                continue
            y = at // width
            x = at - y * width
            index = (y // cell) * columns + x // cell
            xs[count], ys[count], cells[count] = x, y, index
            histogram[index, scores[at]] += 1
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


@kernel
def refine(scores, xs, ys, out):  # type: ignore[no-untyped-def]
    """Overwrite `out` (n, 2) float32 with x, y of the top of a parabola through each peak.

    scores (h, w) uint8; xs, ys (n,) int32 as `list_peaks` found them. This takes a third off
    the deviation of a corner over the nearest pixel (measured on exact poses: 0.43 to 0.29 px).
    """
    for i in range(xs.shape[0]):
        x, y = xs[i], ys[i]
        middle = 2.0 * scores[y, x]
        left, right = float(scores[y, x - 1]), float(scores[y, x + 1])
        above, below = float(scores[y - 1, x]), float(scores[y + 1, x])
        dx, dy = 0.0, 0.0
        if middle > left + right:
            dx = 0.5 * (right - left) / (middle - left - right)
        if middle > above + below:
            dy = 0.5 * (below - above) / (middle - above - below)
        out[i, 0] = np.float32(x + min(0.5, max(-0.5, dx)))
        out[i, 1] = np.float32(y + min(0.5, max(-0.5, dy)))
