# SPDX-License-Identifier: Apache-2.0
"""Where edges meet in an image: nearly always they do so in space, too."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edge.types import F64, Bools

I64 = NDArray[np.int64]

# How near both edges' ends must be to where they meet [px], and how they must cross.
_NEAR_PX, _MIN_SINE = 6.0, 0.3


class Crossings(NamedTuple):
    """Pairs of segments that meet."""

    one: I64  # (n,) numbers of segments
    other: I64  # (n,)
    pixels: F64  # (n, 2) where


class _Meeting(NamedTuple):
    pixels: F64  # (n, 2) of the infinite lines
    along_one: F64  # (n,) from its first end [px]
    along_other: F64
    length_one: F64
    length_other: F64
    sine: F64


def crossings(segments: F64) -> Crossings:
    """Pairs of segments (k, 4), none of them NaN, whose ends meet: corners of boards and rooms.

    Where an edge ends in the middle of another it mostly passes behind it.
    """
    one, other = np.triu_indices(len(segments), 1)
    m = _meeting(segments, one, other)
    near = np.maximum(_to_end(m.along_one, m.length_one), _to_end(m.along_other, m.length_other))
    chosen = (near < _NEAR_PX) & (m.sine > _MIN_SINE)
    return Crossings(one[chosen], other[chosen], m.pixels[chosen])


def still_meet(segments: F64, where: Crossings) -> Bools:
    """Whether both (n,) are seen, in `segments` (k, 4), as far as where they meet."""
    m = _meeting(segments, where.one, where.other)
    beyond = np.maximum(_beyond(m.along_one, m.length_one), _beyond(m.along_other, m.length_other))
    return np.asarray(beyond < _NEAR_PX)  # not so where one is NaN


def _meeting(segments: F64, one: I64, other: I64) -> _Meeting:
    a, b = segments[one], segments[other]
    along, across = a[:, 2:] - a[:, :2], b[:, 2:] - b[:, :2]
    apart = b[:, :2] - a[:, :2]
    length, width = np.linalg.norm(along, axis=1), np.linalg.norm(across, axis=1)
    area = _cross(along, across)
    parallel = np.abs(area) < 1e-9 * length * width
    area = np.where(parallel, np.nan, area)
    on_a, on_b = _cross(apart, across) / area, _cross(apart, along) / area
    return _Meeting(
        a[:, :2] + on_a[:, None] * along,
        on_a * length,
        on_b * width,
        length,
        width,
        np.abs(area) / (length * width),
    )


def _cross(a: F64, b: F64) -> F64:
    return np.asarray(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])


def _to_end(along: F64, length: F64) -> F64:
    """Distance to the nearer end."""
    return np.minimum(np.abs(along), np.abs(along - length))


def _beyond(along: F64, length: F64) -> F64:
    """How far beyond the nearer end, 0 between them."""
    return np.asarray(np.maximum(np.maximum(-along, along - length), 0.0))
