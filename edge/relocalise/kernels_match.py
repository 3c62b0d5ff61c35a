# SPDX-License-Identifier: Apache-2.0
"""Nearest descriptors: all against all, and within windows around projections."""

import numpy as np

from edge.kernel import kernel
from edge.relocalise.kernels_bow import hamming, popcount
from edge.types import F32, I32

# Distance and row in one int32, so that the least key is the nearest row, ties by row.
_ROW_BITS = 22
MAX_ROWS = 1 << _ROW_BITS
_ROW_MASK = MAX_ROWS - 1
_NONE = np.int32(0x7FFFFFFF)


@kernel
def match_all(query, columns, point, max_bits, distances, row_best, best, distance):  # type: ignore[no-untyped-def]
    """Write the nearest row of each query descriptor, and of its two next other points.

    query      (n, 4)  uint64
    columns    (4, m)  uint64  descriptors of the map, transposed: the row is the vector lane
    point      (m,)    int32   whose descriptor a row is
    max_bits   a nearest row that is further needs no rivals: the next points are left out
    distances  (m,)    int32   work
    row_best   (m,)    int32, out  the query descriptor that is nearest to each row, or -1
    best       (n, 3)  int32, out  rows of the three nearest points, nearest first, or -1
    distance   (n, 3)  int32, out
    """
    m = point.shape[0]
    for j in range(m):
        row_best[j] = _NONE
    for i in range(query.shape[0]):
        q0, q1, q2, q3 = query[i, 0], query[i, 1], query[i, 2], query[i, 3]
        for j in range(m):
            distances[j] = np.int32(
                popcount(q0 ^ columns[0, j])
                + popcount(q1 ^ columns[1, j])
                + popcount(q2 ^ columns[2, j])
                + popcount(q3 ^ columns[3, j])
            )
        for j in range(m):
            row_best[j] = min(row_best[j], np.int32((distances[j] << _ROW_BITS) | i))
        first = second = np.int32(-1)
        for rank in range(3):
            least = _NONE
            for j in range(m):
                key = np.int32((distances[j] << _ROW_BITS) | j)
                taken = (point[j] == first) | (point[j] == second)
                least = min(least, _NONE if taken else key)
            if least == _NONE:
                best[i, rank], distance[i, rank] = -1, 256
                continue
            row = least & _ROW_MASK
            best[i, rank], distance[i, rank] = row, least >> _ROW_BITS
            second = first
            first = point[row]
            if distance[i, 0] > max_bits:
                best[i, 1] = best[i, 2] = -1
                distance[i, 1] = distance[i, 2] = 256
                break
    for j in range(m):
        row_best[j] = -1 if row_best[j] == _NONE else row_best[j] & _ROW_MASK


@kernel
def sort_into_cells(
    pixels: F32, cell_px: int, columns: int, rows: int, start: I32, member: I32
) -> None:
    """List the features of each cell of a grid, in rising order.

    pixels  (n, 2)                float32  u, v; those outside go to the nearest cell
    start   (columns * rows + 1,) int32, out  where each cell's members begin
    member  (n,)                  int32, out
    """
    start[:] = 0
    for i in range(pixels.shape[0]):
        start[_cell(pixels, i, cell_px, columns, rows) + 1] += 1
    for c in range(columns * rows):
        start[c + 1] += start[c]
    for i in range(pixels.shape[0] - 1, -1, -1):
        c = _cell(pixels, i, cell_px, columns, rows)
        start[c + 1] -= 1
        member[start[c + 1]] = i
    for c in range(columns * rows):
        start[c] = start[c + 1]
    start[columns * rows] = pixels.shape[0]


@kernel
def _cell(pixels: F32, i: int, cell_px: int, columns: int, rows: int) -> int:
    x = min(max(int(pixels[i, 0]) // cell_px, 0), columns - 1)
    y = min(max(int(pixels[i, 1]) // cell_px, 0), rows - 1)
    return y * columns + x


@kernel
def match_windows(  # type: ignore[no-untyped-def]
    query,
    pixels,
    octave,
    start,
    member,
    cell_px,
    columns,
    rows,
    descriptors,
    centre,
    radius,
    level,
    max_level_gap,
    out,
    distance,
    rival,
):
    """Write the nearest feature within a window around each projection.

    query        (n, 4)  uint64   descriptors of the image's features
    pixels       (n, 2)  float32
    octave       (n,)    uint8
    start, member, cell_px, columns, rows   their grid, from `sort_into_cells`
    descriptors  (m, 4)  uint64   of the projected points
    centre       (m, 2)  float64  where they project
    radius       (m,)    float64  of the window [px]; 0 to leave a point out
    level        (m,)    float32  octave at which it should appear
    out          (m,)    int32, out  feature or -1
    distance     (m,)    int32, out
    rival        (m,)    int32, out  distance of the next best that lies elsewhere
    """
    for k in range(descriptors.shape[0]):
        out[k], distance[k], rival[k] = -1, 256, 256
        r = radius[k]
        if not r > 0.0:
            continue
        u, v = centre[k, 0], centre[k, 1]
        x0, x1 = max(0, int(u - r) // cell_px), min(columns - 1, int(u + r) // cell_px)
        y0, y1 = max(0, int(v - r) // cell_px), min(rows - 1, int(v + r) // cell_px)
        for y in range(y0, y1 + 1):
            for x in range(x0, x1 + 1):
                cell = y * columns + x
                for at in range(start[cell], start[cell + 1]):
                    i = member[at]
                    du, dv = pixels[i, 0] - u, pixels[i, 1] - v
                    if du * du + dv * dv > r * r:
                        continue
                    if abs(np.float32(octave[i]) - level[k]) > max_level_gap:
                        continue
                    d = hamming(query, i, descriptors, k)
                    if d < distance[k]:
                        if out[k] >= 0 and _apart(pixels, i, out[k]):
                            rival[k] = distance[k]
                        out[k], distance[k] = i, d
                    elif d < rival[k] and _apart(pixels, i, out[k]):
                        rival[k] = d


@kernel
def _apart(pixels: F32, i: int, j: int) -> bool:
    """Whether two features lie at different places, and are not one corner at two octaves."""
    du, dv = pixels[i, 0] - pixels[j, 0], pixels[i, 1] - pixels[j, 1]
    return bool(du * du + dv * dv > 9.0)
