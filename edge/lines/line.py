# SPDX-License-Identifier: Apache-2.0
"""Line segments in an image and lines in space, as arrays.

Where a segment ends is chance: it was hidden, or its contrast sank. What counts is where the
line runs and which way, so both kinds are held as a place on the line and a direction. The
length of a segment says how well its direction is known, and nothing else.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from edge.types import F64, I32, Bools, Pinhole


class Segments(NamedTuple):
    """Segments in one image [ideal px]."""

    middle: F64  # (n, 2)
    direction: F64  # (n, 2) of unit length
    length: F64  # (n,)
    sigma: F64  # (n,) standard deviation of either end across the line


class Lines(NamedTuple):
    """Lines in space; any frame, any unit of length."""

    point: F64  # (n, 3) on the line, near the part of it that was seen
    direction: F64  # (n, 3) of unit length
    covariance: F64  # (n, 4, 4) of shifts of the point, then tilts [rad], along `across`


def segments_between(ends: ArrayLike, sigma_px: ArrayLike) -> Segments:
    """Segments of ends (n, 4) u0 v0 u1 v1, each uncertain by `sigma_px` ((n,) or a number)."""
    ends = np.asarray(ends, np.float64).reshape(-1, 4)
    span = ends[:, 2:] - ends[:, :2]
    length = np.linalg.norm(span, axis=1)
    direction = span / np.maximum(length, 1e-12)[:, None]
    sigma = np.broadcast_to(np.asarray(sigma_px, np.float64), length.shape).copy()
    return Segments(0.5 * (ends[:, 2:] + ends[:, :2]), direction, length, sigma)


def lines_between(first: ArrayLike, last: ArrayLike, sigma: float) -> Lines:
    """Lines through points (n, 3) and (n, 3), each uncertain by `sigma` in all directions."""
    first, last = np.asarray(first, np.float64), np.asarray(last, np.float64)
    length = np.linalg.norm(last - first, axis=1)
    # The middle is the mean of two ends, the tilt their difference over the length.
    variance = np.empty((len(first), 4))
    variance[:, :2] = 0.5 * sigma * sigma
    variance[:, 2:] = (2.0 * sigma * sigma / length**2)[:, None]
    covariance = variance[:, :, None] * np.eye(4)
    return Lines(0.5 * (first + last), (last - first) / length[:, None], covariance)


def ends(segments: Segments) -> F64:
    """Ends (n, 4) u0 v0 u1 v1 of segments."""
    half = 0.5 * segments.length[:, None] * segments.direction
    return np.hstack((segments.middle - half, segments.middle + half))


def across(direction: F64) -> F64:
    """Two unit vectors (n, 2, 3) that stand on each direction (n, 3) and on each other."""
    # The axis that is least along the direction: the same for all but a few directions.
    axis = np.eye(3)[np.argmin(np.abs(direction), axis=1)]
    first = np.cross(direction, axis)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack((first, np.cross(direction, first)), axis=1)


def moved(lines: Lines, step: F64) -> Lines:
    """Lines after steps (n, 4): shifts along `across`, then tilts [rad]; orthonormal always."""
    basis = across(lines.direction)
    point = lines.point + np.einsum("nk,nki->ni", step[:, :2], basis)
    tilted = lines.direction + np.einsum("nk,nki->ni", step[:, 2:], basis)
    direction = tilted / np.linalg.norm(tilted, axis=1, keepdims=True)
    return Lines(point, direction, lines.covariance)


def plane_normals(segments: Segments, camera: Pinhole) -> F64:
    """Unit normals (n, 3) of the planes through the camera's centre and each segment."""
    a, b = -segments.direction[:, 1], segments.direction[:, 0]
    c = -(a * segments.middle[:, 0] + b * segments.middle[:, 1])
    normals = np.column_stack((a * camera.fx, b * camera.fy, a * camera.cx + b * camera.cy + c))
    unit: F64 = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    return unit


def take(lines: Lines, which: I32 | Bools) -> Lines:
    """The lines that an index or mask array names."""
    return Lines(*(array[which] for array in lines))


def take_segments(segments: Segments, which: I32 | Bools) -> Segments:
    """The segments that an index or mask array names."""
    return Segments(*(array[which] for array in segments))
