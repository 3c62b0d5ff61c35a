# SPDX-License-Identifier: Apache-2.0
"""Which features of an image show which points of the map."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edge.config.relocalise import RelocaliseConfig
from edge.relocalise import kernels_match as kernels
from edge.relocalise.features import Features
from edge.relocalise.pool import Pool, unpacked
from edge.relocalise.projection import Projection
from edge.types import F64, I32, Pinhole

Bools = NDArray[np.bool_]
_CELL_PX = 24
_SAMPLED_SIGMA_PX = 2.0  # points less certain than this make no minimal sample,
_MIN_SAMPLED = 20  # unless there are too few others
_SAME_CORNER_PX = 3.0  # features closer than this are one corner, found at two octaves


class Matches(NamedTuple):
    """Features and what they show; each feature and each point occurs once."""

    feature: I32  # (n,)
    row: I32  # (n,) of the pool
    distance: I32  # (n,) bits


def match_all(features: Features, pool: Pool, config: RelocaliseConfig) -> Matches:
    """Match without any idea of the pose: nearest, mutual, unrivalled, turned alike."""
    n, m = len(features.pixels), min(len(pool.point), kernels.MAX_ROWS)
    if n == 0 or m == 0:
        return _none()
    columns = np.ascontiguousarray(pool.descriptors[:m].T)
    best, distance = np.empty((n, 3), np.int32), np.empty((n, 3), np.int32)
    work, row_best = np.empty((2, m), np.int32)
    query = features.descriptors.view(np.uint64)
    kernels.match_all(
        query, columns, pool.point[:m], config.max_bits, work, row_best, best, distance
    )

    near = distance[:, 0] <= config.max_bits
    back = features.pixels[row_best[best[:, 0]]] - features.pixels
    mutual = np.hypot(back[:, 0], back[:, 1]) <= _SAME_CORNER_PX
    row = best[:, 0].copy()
    unrivalled = np.ones(n, bool)
    for rank in (1, 2):
        other = best[:, rank]
        rivalled = distance[:, 0] > config.max_ratio * distance[:, rank]
        rivals = np.flatnonzero(near & rivalled & (other >= 0))
        agreeing = _agree(pool, row[rivals], other[rivals], config)
        unrivalled[rivals[~agreeing]] = False
        # Of points that are one, the one that is known better.
        one = rivals[agreeing]
        better = _uncertainty(pool, other[one]) < _uncertainty(pool, row[one])
        row[one[better]] = other[one[better]]
    feature = np.flatnonzero(near & mutual & unrivalled).astype(np.int32)
    found = Matches(feature, row[feature], distance[feature, 0])
    found = _once_each(found, pool)
    return _taken(found, _turned_alike(found, features, pool, config))


def match_near(
    features: Features,
    pool: Pool,
    projection: Projection,
    camera: Pinhole,
    config: RelocaliseConfig,
) -> Matches:
    """Match around the points' projections: each row of the pool looks into its window."""
    n, m = len(features.pixels), len(pool.point)
    if n == 0 or m == 0:
        return _none()
    columns, rows = -(-camera.width // _CELL_PX), -(-camera.height // _CELL_PX)
    start, member = np.empty(columns * rows + 1, np.int32), np.empty(n, np.int32)
    kernels.sort_into_cells(features.pixels, _CELL_PX, columns, rows, start, member)
    feature, distance, rival = np.empty((3, m), np.int32)
    kernels.match_windows(
        features.descriptors.view(np.uint64),
        features.pixels,
        features.octave,
        start,
        member,
        _CELL_PX,
        columns,
        rows,
        pool.descriptors,
        projection.centre[pool.point],
        projection.radius_px,
        projection.level,
        np.float32(config.guided_octaves),
        feature,
        distance,
        rival,
    )
    good = (feature >= 0) & (distance <= config.guided_max_bits)
    good &= distance <= config.guided_max_ratio * rival
    row = np.flatnonzero(good).astype(np.int32)
    return _once_each(Matches(feature[row], row, distance[row]), pool)


def most_promising(found: Matches, pool: Pool) -> I32:
    """Indices of the matches to sample poses from: certain points, nearest descriptors first."""
    C, ray = unpacked(pool.C[pool.point[found.row]]), pool.ray[found.row]
    along = np.einsum("ij,ijk,ik->i", ray, C, ray)
    across = 0.5 * np.maximum(np.trace(C, axis1=1, axis2=2) - along, 0.0)
    sigma_px = np.sqrt(across) / pool.pixel_m[found.row]
    order = np.lexsort((found.feature, found.distance))
    certain = order[sigma_px[order] <= _SAMPLED_SIGMA_PX]
    return (certain if len(certain) >= _MIN_SAMPLED else order).astype(np.int32)


def _agree(pool: Pool, row: I32, other: I32, config: RelocaliseConfig) -> Bools:
    """Whether the points of two rows each (n,) are one: a duplicate that was not fused."""
    a, b = pool.point[row], pool.point[other]
    apart = pool.xyz[a] - pool.xyz[b]
    near = config.agree_px * pool.pixel_m[row]
    C = unpacked(pool.C[a] + pool.C[b]) + near[:, None, None] ** 2 * np.eye(3)
    m2 = np.einsum("ij,ij->i", apart, np.linalg.solve(C, apart[:, :, None])[:, :, 0])
    return np.asarray(m2 <= config.agree_sigmas**2, np.bool_)


def _uncertainty(pool: Pool, row: I32) -> F64:
    C = pool.C[pool.point[row]]
    return np.asarray(C[:, 0] + C[:, 3] + C[:, 5], np.float64)


def _once_each(found: Matches, pool: Pool) -> Matches:
    """Of the matches of one feature, and then of one point, the nearest."""
    found = _taken(found, np.lexsort((found.row, found.distance)))
    found = _taken(found, np.sort(np.unique(found.feature, return_index=True)[1]))
    return _taken(found, np.unique(pool.point[found.row], return_index=True)[1])


def _turned_alike(
    found: Matches, features: Features, pool: Pool, config: RelocaliseConfig
) -> Bools:
    """Whether each match turns like most of those with the same keyframe."""
    turn = features.angle_rad[found.feature] - pool.angle_rad[found.row]
    n_bins = config.turn_bins
    bins = np.floor(turn / (2.0 * math.pi) * n_bins + 0.5).astype(np.int64) % n_bins
    slot = pool.slot[found.row]
    counts = np.zeros((len(pool.keyframes), n_bins), np.int64)
    np.add.at(counts, (slot, bins), 1)
    # A patch on the border of two bins counts for both.
    wide = counts + np.roll(counts, 1, axis=1) + np.roll(counts, -1, axis=1)
    return np.asarray(wide[slot, bins] >= config.turn_min_share * wide.max(axis=1)[slot], np.bool_)


def _taken(found: Matches, which: NDArray[np.generic]) -> Matches:
    return Matches(found.feature[which], found.row[which], found.distance[which])


def _none() -> Matches:
    return Matches(*(np.empty(0, np.int32),) * 3)
