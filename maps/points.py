# SPDX-License-Identifier: Apache-2.0
"""Which features and points a map keeps, and what else it says of each point."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from edge.types import F64, I32, Mat4
from maps.fusion import Points
from maps.matching import MatchSide

I64 = NDArray[np.int64]

_CELL_PX = 80


class StoredPoints(NamedTuple):
    """Points of the map, by their first view; the observations of each by view."""

    xyz: F64  # (n, 3)
    lower: F64  # (n, 6) Cholesky factor of the covariance, row by row
    parallax_rad: F64  # (n,)
    direction: F64  # (n, 3) mean unit vector to the cameras
    half_angle_rad: F64  # (n,)
    pixel_size: F64  # (n,)
    n_views: I64  # (n,) that agree, stored or not
    offsets: I64  # (n + 1,)
    view: I32  # (m,)
    feature: I32  # (m,) of the description
    stored: I32  # (m,) index among the stored features of its view
    features: list[I32]  # of each view: the described features that are stored
    point: list[I32]  # of each view: the point of each stored feature


def store(
    points: Points, poses: list[Mat4], sides: list[MatchSide], max_features: int
) -> StoredPoints:
    """Keep the best features of each view: those that most views share come first."""
    owner = np.repeat(np.arange(len(points.xyz)), np.diff(points.offsets))
    kept = _best_of_views(points, owner, sides, max_features)
    owner, view, feature = owner[kept], points.view[kept], points.feature[kept]
    # Points in the order of their first view, so that a tile's points lie together.
    first = np.flatnonzero(np.diff(owner, prepend=-1))
    order = np.lexsort((feature[first], view[first]))
    rank = np.full(len(points.xyz), -1)
    rank[owner[first][order]] = np.arange(len(order))
    rows = np.argsort(rank[owner], kind="stable")
    owner, view, feature = rank[owner][rows], view[rows], feature[rows]
    source = np.flatnonzero(rank >= 0)[np.argsort(rank[rank >= 0])]
    features, point, stored = _by_view(owner, view, feature, len(poses))
    xyz = points.xyz[source]
    direction, half_angle = viewing(xyz, owner, view, poses)
    lower = np.linalg.cholesky(points.covariance[source])
    return StoredPoints(
        xyz=xyz,
        lower=lower[:, *np.tril_indices(3)].astype(np.float64),
        parallax_rad=points.parallax_rad[source],
        direction=direction,
        half_angle_rad=half_angle,
        pixel_size=_pixel_size(xyz, owner, view, feature, poses, sides),
        n_views=np.diff(points.offsets)[source],
        offsets=np.concatenate([[0], np.cumsum(np.bincount(owner, minlength=len(xyz)))]),
        view=view,
        feature=feature,
        stored=stored,
        features=features,
        point=point,
    )


def _best_of_views(
    points: Points, owner: NDArray[np.int64], sides: list[MatchSide], max_features: int
) -> NDArray[np.int64]:
    """Rows of the observations that are kept, ascending.

    Every cell of an image gives its best before any gives its next, so that what is seen at the
    edge of the map alone is not crowded out by what all views share.
    """
    spread = np.sqrt(np.linalg.eigvalsh(points.covariance)[:, 2])[owner]
    seen = np.diff(points.offsets)[owner]
    kept = []
    for side, rows in zip(sides, _rows_by_view(points.view, len(sides)), strict=True):
        columns = side.pinhole.width // _CELL_PX + 1
        u, v = (side.pixels[points.feature[rows]] // _CELL_PX).astype(np.int64).T
        turn = _turns(v * columns + u, -seen[rows], spread[rows])
        best = np.lexsort((spread[rows], -seen[rows], turn))[:max_features]
        kept.append(rows[best])
    return np.sort(np.concatenate(kept))


def _rows_by_view(view: I32, n_views: int) -> list[I64]:
    """Rows of the observations of each view, ascending."""
    order = np.argsort(view, kind="stable")
    borders = np.searchsorted(view[order], np.arange(1, n_views))
    return np.split(order, borders)


def _turns(cell: I64, *order: NDArray[Any]) -> I64:
    """Place (n,) of each within its cell, by `order`, the first of which counts most."""
    ranked = np.lexsort((*reversed(order), cell))
    starts = np.flatnonzero(np.diff(cell[ranked], prepend=np.inf))
    lengths = np.diff(np.append(starts, len(cell)))
    turn = np.empty(len(cell), np.int64)
    turn[ranked] = np.arange(len(cell)) - np.repeat(starts, lengths)
    return turn


def _by_view(
    owner: NDArray[np.int64], view: I32, feature: I32, n_views: int
) -> tuple[list[I32], list[I32], I32]:
    features, point = [], []
    stored = np.zeros(len(owner), np.int32)
    for rows in _rows_by_view(view, n_views):
        rows = rows[np.argsort(feature[rows], kind="stable")]
        stored[rows] = np.arange(len(rows))
        features.append(feature[rows])
        point.append(owner[rows].astype(np.int32))
    return features, point, stored


def viewing(xyz: F64, owner: NDArray[np.int64], view: I32, poses: list[Mat4]) -> tuple[F64, F64]:
    """Mean unit vector (n, 3) from each point to its cameras, and the widest angle off it (n,)."""
    centres = np.array([pose[:3, 3] for pose in poses])
    towards = centres[view] - xyz[owner]
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    mean = np.zeros_like(xyz)
    np.add.at(mean, owner, towards)
    mean /= np.linalg.norm(mean, axis=1, keepdims=True)
    cosine = np.ones(len(xyz))
    np.minimum.at(cosine, owner, np.einsum("mi,mi->m", mean[owner], towards))
    return mean, np.arccos(np.clip(cosine, -1.0, 1.0))


def _pixel_size(
    xyz: F64,
    owner: NDArray[np.int64],
    view: I32,
    feature: I32,
    poses: list[Mat4],
    sides: list[MatchSide],
) -> F64:
    """Length (n,) at each point of a pixel of the octave in which it was seen; geometric mean."""
    axes = np.array([pose[:3, 2] for pose in poses])
    centres = np.array([pose[:3, 3] for pose in poses])
    depth = np.einsum("mi,mi->m", axes[view], xyz[owner] - centres[view])
    focal = np.array([side.pinhole.fx for side in sides])[view]
    base = np.concatenate([[0], np.cumsum([len(side.sigma) for side in sides])])
    scale = np.concatenate([side.sigma for side in sides])[base[view] + feature]
    total = np.bincount(owner, np.log(depth / focal * scale), minlength=len(xyz))
    return np.exp(total / np.bincount(owner, minlength=len(xyz)))
