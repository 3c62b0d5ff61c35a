# SPDX-License-Identifier: Apache-2.0
"""Where a point may be seen in another frame: epipolar lines and what a match on them tells."""

import math
from typing import TypeAlias

import numpy as np

from edge.kernel import inline_kernel
from edge.odometry.kernels_window import PATTERN_SIZE, PATTERN_U, PATTERN_V
from edge.types import F32

Two: TypeAlias = tuple[np.float32, np.float32]
Three: TypeAlias = tuple[np.float32, np.float32, np.float32]

ZERO, ONE = np.float32(0.0), np.float32(1.0)
FAR = np.float32(1e-6)
MIN_Z = np.float32(0.05)  # of a point one unit away, before it counts as behind the camera
EDGE = np.float32(4.0)
# Statuses of a candidate.
FRESH, GOOD, OUT, BAD, SKIPPED, FLAT = 0, 1, 2, 3, 4, 5


@inline_kernel
def line_of(
    low: np.float32,
    high: np.float32,
    ray: Three,
    warp: F32,
    intrinsics: F32,
    size: tuple[int, int],
    max_search_px: np.float32,
) -> tuple[int, Two, Two, np.float32]:
    """Where a point may be seen: status, start and direction of a line, its length [px].

    From the inverse depth `low` to `high`, or as far as is searched where `high` is nan. GOOD
    if it is worth a search, SKIPPED if it is too short for one, OUT if it leaves the image.
    """
    ax, ay, az = ray
    nowhere = (ZERO, ZERO)
    z_low = az + warp[11] * low
    if z_low < MIN_Z:
        return OUT, nowhere, nowhere, ZERO
    u_low, v_low = _seen_at(ray, low, z_low, warp, intrinsics)
    start = (u_low, v_low)
    if not _is_inside(u_low, v_low, size):
        return OUT, start, nowhere, ZERO
    if high == high:
        z_high = az + warp[11] * high
        if z_high < MIN_Z:
            return OUT, start, nowhere, ZERO
        u_high, v_high = _seen_at(ray, high, z_high, warp, intrinsics)
        if not _is_inside(u_high, v_high, size):
            return OUT, start, nowhere, ZERO
        du, dv = u_high - u_low, v_high - v_low
        length = np.sqrt(du * du + dv * dv)
        if length < np.float32(1.5):
            return SKIPPED, start, nowhere, length
        along = (du / length, dv / length)
        length = length if length < max_search_px else max_search_px
    else:
        # Direction of the line at `low`; exact for any step along it.
        du = intrinsics[0] * (warp[9] * az - warp[11] * ax)
        dv = intrinsics[1] * (warp[10] * az - warp[11] * ay)
        norm = math.sqrt(du * du + dv * dv)
        if not norm > np.float32(1e-12):
            return SKIPPED, start, nowhere, ZERO
        along, length = (du / norm, dv / norm), max_search_px
        if not _is_inside(u_low + along[0] * length, v_low + along[1] * length, size):
            return OUT, start, along, length
    grows_much = not (np.float32(0.6) < az and az < np.float32(1.7))
    return OUT if grows_much else GOOD, start, along, length


@inline_kernel
def _seen_at(ray: Three, idepth: np.float32, z: np.float32, warp: F32, intrinsics: F32) -> Two:
    """Pixel at which a point of this inverse depth is seen."""
    u = intrinsics[0] * (ray[0] + warp[9] * idepth) / z + intrinsics[2]
    v = intrinsics[1] * (ray[1] + warp[10] * idepth) / z + intrinsics[3]
    return u, v


@inline_kernel
def _is_inside(u: np.float32, v: np.float32, size: tuple[int, int]) -> bool:
    """Whether a whole pattern about this pixel has values."""
    right, bottom = np.float32(size[0] - 5), np.float32(size[1] - 5)
    return bool(u > EDGE and v > EDGE and u < right and v < bottom)


@inline_kernel
def error_px_of(gxx: np.float32, gxy: np.float32, gyy: np.float32, along: Two) -> np.float32:
    """Sigma of a match along the line: large where gradients run across it."""
    du, dv = along
    parallel = du * (du * gxx + dv * gxy) + dv * (du * gxy + dv * gyy)
    across = dv * (dv * gxx - du * gxy) + du * (du * gyy - dv * gxy)
    return np.float32(0.2) + np.float32(0.2) * (parallel + across) / max(parallel, FAR)


@inline_kernel
def turn_pattern(ray: Three, idepth: np.float32, warp: F32, pattern: F32) -> None:
    """Turn and grow the pattern (2, 8) as it is seen from the new frame."""
    z = ray[2] + warp[11] * idepth
    scale = ONE / z if z > np.float32(0.1) else ONE
    m00 = (warp[0] - warp[6] * ray[0] * scale) * scale
    m01 = (warp[1] - warp[7] * ray[0] * scale) * scale
    m10 = (warp[3] - warp[6] * ray[1] * scale) * scale
    m11 = (warp[4] - warp[7] * ray[1] * scale) * scale
    for q in range(PATTERN_SIZE):
        pattern[0, q] = m00 * PATTERN_U[q] + m01 * PATTERN_V[q]
        pattern[1, q] = m10 * PATTERN_U[q] + m11 * PATTERN_V[q]


@inline_kernel
def interval_of(
    u: np.float32,
    v: np.float32,
    along: Two,
    error_px: np.float32,
    ray: Three,
    warp: F32,
    intrinsics: F32,
) -> Two:
    """Inverse depths of a match less and plus its error, by the longer image axis."""
    if along[0] * along[0] > along[1] * along[1]:
        at, reach, f, c, a, t = (
            u,
            error_px * along[0],
            intrinsics[0],
            intrinsics[2],
            ray[0],
            warp[9],
        )
    else:
        at, reach, f, c, a, t = (
            v,
            error_px * along[1],
            intrinsics[1],
            intrinsics[3],
            ray[1],
            warp[10],
        )
    one, other = (at - reach - c) / f, (at + reach - c) / f
    d_one = (one * ray[2] - a) / (t - warp[11] * one)
    d_other = (other * ray[2] - a) / (t - warp[11] * other)
    return min(d_one, d_other), max(d_one, d_other)
