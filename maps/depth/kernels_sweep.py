# SPDX-License-Identifier: Apache-2.0
"""Plane sweep by census and semi-global matching: one depth for each pixel of an image.

Neighbours come derotated: their images are what a camera at the neighbour's place would see with
the axes and intrinsics of the reference. A plane of inverse depth r then moves the reference's
pixel (u, v) to ((u - cx + r fx tx) / (1 + r tz) + cx, ...): a scale and a shift.
"""

import numpy as np

from edge.kernel import kernel
from edge.relocalise.kernels_bow import popcount
from edge.types import F32, U8

BITS = 48  # of a census of 7x7 pixels without its centre
UNSEEN = 255  # cost where no neighbour sees the pixel
_REACH = 3
_SCALE = np.float32(4.0)  # costs are stored in quarters of a bit
_FAR = np.float32(1e9)
_ONE, _HALF = np.float32(1.0), np.float32(0.5)


@kernel
def census(image, out):  # type: ignore[no-untyped-def]
    """Write which of the 48 pixels around each are darker than it.

    image  (h, w)  float32
    out    (h, w)  uint64, out; 0 within 3 px of the border
    """
    height, width = image.shape
    out[:] = 0
    for v in range(_REACH, height - _REACH):
        for dv in range(-_REACH, _REACH + 1):
            for du in range(-_REACH, _REACH + 1):
                if du == 0 and dv == 0:
                    continue
                for u in range(_REACH, width - _REACH):
                    darker = np.uint64(1) if image[v + dv, u + du] < image[v, u] else np.uint64(0)
                    out[v, u] = (out[v, u] << np.uint64(1)) | darker


@kernel
def sweep(codes, valid, others, others_valid, shifts, rho, kept, buffer, bits, cost):  # type: ignore[no-untyped-def]
    """Write the cost of each plane at each pixel: the mean of the neighbours that agree best.

    codes         (h, w)        uint64  census of the reference
    valid         (h, w)        uint8
    others        (n, h2, w2)   uint64  of the derotated neighbours
    others_valid  (n, h2, w2)   uint8
    shifts        (n, 7)        float32  fx tx, fy ty, tz, cx, cy, and the margins of `others`
    rho           (d,)          float32  inverse depth of each plane
    kept          int           how many neighbours count at a pixel
    buffer        (d, w)        uint8, scratch
    bits          (n, w)        float32, scratch
    cost          (h, w, d)     uint8, out  quarters of a bit, 192 at most; UNSEEN
    """
    height, width = codes.shape
    n, height2, width2 = others.shape
    planes = len(rho)
    flat, flat_valid = others.reshape(-1), others_valid.reshape(-1)
    own = np.empty(width, np.uint64)
    far = np.float32(1e6)
    for v in range(height):
        for u in range(width):
            own[u] = codes[v, u]
        for d in range(planes):
            r = rho[d]
            for j in range(n):
                a = _ONE / (_ONE + r * shifts[j, 2])
                cx, cy = shifts[j, 3], shifts[j, 4]
                b = (r * shifts[j, 0] - cx) * a + cx + shifts[j, 5] + _HALF
                y = np.int32(
                    (np.float32(v) - cy + r * shifts[j, 1]) * a + cy + shifts[j, 6] + _HALF
                )
                inside = a > 0.0 and 0 <= y < height2
                row = np.int32((j * height2 + (y if inside else 0)) * width2)
                for u in range(width):
                    x = np.int32(np.float32(u) * a + b)
                    ok = inside & (x >= 0) & (x < width2)
                    at = row + (x if ok else np.int32(0))
                    different = np.float32(popcount(own[u] ^ flat[at]))
                    bits[j, u] = different if ok & (flat_valid[at] != 0) else far
            _combine(bits, kept, buffer[d])
        for u in range(width):
            if valid[v, u] == 0:
                for d in range(planes):
                    cost[v, u, d] = UNSEEN
            else:
                for d in range(planes):
                    cost[v, u, d] = buffer[d, u]


@kernel
def _combine(bits, kept, out):  # type: ignore[no-untyped-def]
    """Mean of the `kept` least of up to four costs."""
    n, width = bits.shape
    if n == 4 and kept < 4:
        for u in range(width):
            a, b, c, d = bits[0, u], bits[1, u], bits[2, u], bits[3, u]
            a, b = min(a, b), max(a, b)
            c, d = min(c, d), max(c, d)
            a, c = min(a, c), max(a, c)
            b, d = min(b, d), max(b, d)
            b, c = min(b, c), max(b, c)
            two = _HALF * (a + b)
            three = (a + b + c) / np.float32(3.0)
            best = two if (kept == 2) | (c > BITS) else three
            best = a if b > BITS else best
            out[u] = np.uint8(_SCALE * best) if a <= BITS else np.uint8(UNSEEN)
        return
    for u in range(width):
        total, count, least = np.float32(0.0), np.float32(0.0), np.float32(1e6)
        for j in range(n):
            if bits[j, u] <= BITS:
                total += bits[j, u]
                count += _ONE
                least = min(least, bits[j, u])
        if count == 0:
            out[u] = UNSEEN
        elif count == 2 and kept < n:
            out[u] = np.uint8(_SCALE * (_HALF * (total / count + least)))
        else:
            out[u] = np.uint8(_SCALE * total / count)


@kernel
def _step(cost, previous, p1, p2, out):  # type: ignore[no-untyped-def]
    """One step of a path. The planes' costs lie between two of _FAR; their least comes last."""
    planes = len(cost)
    least = previous[planes + 2]
    jump = least + p2
    for d in range(planes):
        best = min(previous[d + 1], jump)
        best = min(best, min(previous[d], previous[d + 2]) + p1)
        out[d + 1] = np.float32(cost[d]) + best - least
    smallest = out[1]
    for d in range(1, planes):
        smallest = min(smallest, out[d + 1])
    out[planes + 2] = smallest


@kernel
def _begin(rows):  # type: ignore[no-untyped-def]
    """Make rows (n, d + 3) those of a path that begins."""
    rows[:] = 0.0
    rows[:, 0] = _FAR
    rows[:, rows.shape[1] - 2] = _FAR


@kernel
def aggregate(cost, grey, p1, p2, paths, total):  # type: ignore[no-untyped-def]
    """Sum over the paths that end at each pixel (Hirschmueller 2008), from four or eight sides.

    cost   (h, w, d)          uint8
    grey   (h, w)             float32; a jump of depth is cheaper where the grey value jumps
    paths  (2, 3, w + 2, d + 3)  float32, scratch
    total  (h, w, d)          float32, out
    """
    height, width, planes = cost.shape
    for backward in range(2):
        _begin(paths.reshape(-1, planes + 3))
        side = np.zeros((2, planes + 3), np.float32)
        for row in range(height):
            v = height - 1 - row if backward else row
            now, before = row % 2, 1 - row % 2
            _begin(side)
            for step in range(width):
                u = width - 1 - step if backward else step
                down = 1 if backward else -1
                if row == 0:
                    penalty = p2
                else:
                    penalty = p2 / (_ONE + np.float32(0.1) * abs(grey[v, u] - grey[v + down, u]))
                penalty = max(penalty, np.float32(1.2) * p1)
                sideways = p2
                if step > 0:
                    sideways = p2 / (_ONE + np.float32(0.1) * abs(grey[v, u] - grey[v, u + down]))
                    sideways = max(sideways, np.float32(1.2) * p1)
                here = cost[v, u]
                _step(here, side[1 - step % 2], p1, sideways, side[step % 2])
                out = side[step % 2]
                _step(here, paths[before, 1, u + 1], p1, penalty, paths[now, 1, u + 1])
                middle = paths[now, 1, u + 1]
                if backward:
                    for d in range(planes):
                        total[v, u, d] += out[d + 1] + middle[d + 1]
                else:
                    for d in range(planes):
                        total[v, u, d] = out[d + 1] + middle[d + 1]
                _step(here, paths[before, 0, u], p1, penalty, paths[now, 0, u + 1])
                left = paths[now, 0, u + 1]
                _step(here, paths[before, 2, u + 2], p1, penalty, paths[now, 2, u + 1])
                right = paths[now, 2, u + 1]
                for d in range(planes):
                    total[v, u, d] += left[d + 1] + right[d + 1]


@kernel
def choose(total: F32, cost: U8, rho: F32, out: F32, margin: F32) -> None:
    """Write the best inverse depth of each pixel, between planes, and how clearly it is the best.

    total   (h, w, d)  float32
    cost    (h, w, d)  uint8
    rho     (d,)       float32  in equal steps
    out     (h, w)     float32, out; 0 where there is none
    margin  (h, w)     float32, out  second best over best cost; planes beside the best left out
    """
    height, width, planes = total.shape
    step = rho[1] - rho[0]
    for v in range(height):
        for u in range(width):
            best = 0
            for d in range(planes):
                if total[v, u, d] < total[v, u, best]:
                    best = d
            out[v, u], margin[v, u] = 0.0, 0.0
            if cost[v, u, best] == UNSEEN:
                continue
            second = np.float32(1e30)
            for d in range(planes):
                if abs(d - best) > 2:
                    second = min(second, total[v, u, d])
            margin[v, u] = second / max(total[v, u, best], _ONE)
            offset = np.float32(0.0)
            if 0 < best < planes - 1:
                low, middle, high = total[v, u, best - 1], total[v, u, best], total[v, u, best + 1]
                curve = low - np.float32(2.0) * middle + high
                if curve > 0.0:
                    offset = _HALF * (low - high) / curve
            out[v, u] = rho[best] + offset * step
