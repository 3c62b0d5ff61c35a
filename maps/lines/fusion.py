# SPDX-License-Identifier: Apache-2.0
"""Segments that show the same, joined over all views and fused into lines."""

import numpy as np
from numpy.typing import NDArray

from edge.geometry import se3
from edge.lines import kernels_associate
from edge.lines.line import Lines, Segments, across, take
from edge.lines.structure import Structure, Views, triangulate
from edge.lines.threeview import Posed
from edge.types import F64, I32, Bools, Pinhole
from maps.lines.layer import LineLayer

I64 = NDArray[np.int64]

_MIN_VOTES = 2  # views that say of two segments that they show one line
_MIN_VIEWS = 3
# Two segments of one view are pieces of one edge within these.
_PIECE_PX, _PIECE_COSINE = 3.0, 0.998
_GATE_CHI2 = 13.8  # 99.9 % of two freedoms
_MEDIAN_CHI2 = 1.386
# Lines that are known worse say too little where a pose could need them.
_MAX_SHIFT_SHARE = 0.02  # of their distance
_MAX_TILT_RAD = 0.1
# Of the views that should see a line; hidden ones had 0.05, but so have those that are none.
_MIN_SEEN_SHARE = 0.15
_MARGIN_PX, _MIN_SEEN_PX = 4.0, 30.0


def join_segments(
    views: list[Posed], neighbours: list[list[int]], matched: list[I32]
) -> list[tuple[I64, I64]]:
    """Segments (view, segment) that show one line, for each line."""
    base = np.concatenate([[0], np.cumsum([len(v.drawn.segments.length) for v in views])])
    votes = [np.empty((0, 2), np.int64)]
    for k, (others, found) in enumerate(zip(neighbours, matched, strict=True)):
        for s, row in enumerate(found):
            there = np.flatnonzero(row >= 0)
            nodes = np.sort([base[k] + s, *(base[others[j]] + row[j] for j in there)])
            first, second = np.triu_indices(len(nodes), 1)
            votes.append(np.column_stack((nodes[first], nodes[second])))
    pairs, count = np.unique(np.concatenate(votes), axis=0, return_counts=True)
    order = np.argsort(-count, kind="stable")
    chains = _Chains(views, base)
    for first, second in pairs[order[: np.count_nonzero(count >= _MIN_VOTES)]].tolist():
        chains.join(first, second)
    return [track for track in chains.tracks() if len(np.unique(track[0])) >= _MIN_VIEWS]


class _Chains:
    """Segments joined one pair after the other, where no view shows that they are two lines."""

    def __init__(self, views: list[Posed], base: I64) -> None:
        self._segments = [view.drawn.segments for view in views]
        self._base = base
        self._view = np.repeat(np.arange(len(views)), np.diff(base)).tolist()
        self._chain_of: dict[int, int] = {}
        self._members: dict[int, dict[int, list[int]]] = {}  # of each chain, by view

    def join(self, first: int, second: int) -> None:
        """Take two segments, numbered over all views, for one line."""
        a, b = self._of(first), self._of(second)
        if a == b:
            return
        one, other = self._members[a], self._members[b]
        if len(one) < len(other):
            a, b, one, other = b, a, other, one
        for view in one.keys() & other.keys():
            if not all(self._are_one(view, m, n) for m in one[view] for n in other[view]):
                return
        for view, members in other.items():
            one.setdefault(view, []).extend(members)
            self._chain_of.update((member, a) for member in members)
        del self._members[b]

    def tracks(self) -> list[tuple[I64, I64]]:
        """View and index there of the segments of each chain, in the order of the images."""
        chains = [
            sorted(node for nodes in views.values() for node in nodes)
            for views in self._members.values()
        ]
        found = []
        for chain in sorted(chains):
            nodes = np.array(chain)
            view = np.array([self._view[node] for node in chain])
            found.append((view, nodes - self._base[view]))
        return found

    def _of(self, node: int) -> int:
        if node not in self._chain_of:
            self._chain_of[node] = node
            self._members[node] = {self._view[node]: [node]}
        return self._chain_of[node]

    def _are_one(self, view: int, first: int, second: int) -> bool:
        """Whether two segments of a view are pieces of one edge."""
        segments = self._segments[view]
        i, j = first - self._base[view], second - self._base[view]
        d = segments.direction[i]
        if segments.direction[j] @ d < _PIECE_COSINE:
            return False
        away = segments.middle[j] - segments.middle[i]
        return bool(abs(away[0] * d[1] - away[1] * d[0]) < _PIECE_PX)


def fuse(views: list[Posed], tracks: list[tuple[I64, I64]], camera: Pinhole) -> LineLayer:
    """Lines of the tracks without the segments that do not fit."""
    seen = [_views_of(views, track) for track in tracks]
    first = triangulate(seen, camera)
    # Segments err by more than they say: poses, and lenses. Their scatter is the unit.
    scatter = np.concatenate([np.empty(0), *first.m2])
    unit = max(1.0, float(np.median(scatter)) / _MEDIAN_CHI2) if len(scatter) else 1.0
    kept = [m2 < _GATE_CHI2 * unit for m2 in first.m2]
    enough = [len(np.unique(t[0][k])) >= _MIN_VIEWS for t, k in zip(tracks, kept, strict=True)]
    tracks = [(t[0][k], t[1][k]) for t, k, good in zip(tracks, kept, enough, strict=True) if good]
    found = triangulate([_views_of(views, track, np.sqrt(unit)) for track in tracks], camera)
    good = np.flatnonzero(found.known & _certain(found, views, tracks))
    signs = np.array([_sign(found.lines, int(k), views, tracks[k]) for k in good]).reshape(-1, 1)
    lines = take(found.lines, good.astype(np.int32))
    span = found.span[good]
    lines, span = _turned(lines, span, signs)
    pairs = [(np.unique(tracks[k][0]), row) for row, k in enumerate(good)]
    view = np.concatenate([np.empty(0, np.int64), *(own for own, _ in pairs)])
    line = np.repeat(np.arange(len(pairs)), [len(own) for own, _ in pairs])
    counts = np.array([len(own) for own, _ in pairs], np.int64)
    return LineLayer.of(lines, span, counts, (view.astype(np.int32), line.astype(np.int32)))


def trusted(layer: LineLayer, views: list[Posed], camera: Pinhole) -> LineLayer:
    """The lines that enough of the views see from which they should be seen."""
    ends = layer.point[:, None] + layer.span[:, :, None] * layer.direction[:, None]
    first, last = np.ascontiguousarray(ends[:, 0]), np.ascontiguousarray(ends[:, 1])
    expected = np.zeros(len(ends))
    projected = np.empty((len(ends), 4))
    for view in views:
        kernels_associate.project(first, last, view.T_cam_lines, camera, _MARGIN_PX, projected)
        extent = projected[:, 2:] - projected[:, :2]
        expected += np.hypot(extent[:, 0], extent[:, 1]) >= _MIN_SEEN_PX
    return layer.without(np.asarray(layer.n_views < _MIN_SEEN_SHARE * expected, np.bool_))


def _views_of(views: list[Posed], track: tuple[I64, I64], unit: float = 1.0) -> Views:
    rows = [[array[s] for array in views[v].drawn.segments] for v, s in zip(*track, strict=True)]
    middle, direction, length, sigma = (np.array(c) for c in zip(*rows, strict=True))
    T = np.array([views[v].T_cam_lines for v in track[0]])
    return Views(Segments(middle, direction, length, unit * sigma), T)


def _certain(found: Structure, views: list[Posed], tracks: list[tuple[I64, I64]]) -> Bools:
    """Whether lines are known well by their distance."""
    variance = np.array([np.diag(c) for c in found.lines.covariance]).reshape(-1, 4)
    distance = np.array(
        [
            np.linalg.norm(se3.transform(views[int(track[0][0])].T_cam_lines, point[None])[0])
            for track, point in zip(tracks, found.lines.point, strict=True)
        ]
    )
    shift = np.sqrt(variance[:, :2].max(axis=1, initial=0.0))
    tilt = np.sqrt(variance[:, 2:].max(axis=1, initial=0.0))
    is_ahead = np.isfinite(found.lines.point).all(axis=1)
    return np.asarray(
        is_ahead & (shift < _MAX_SHIFT_SHARE * distance) & (tilt < _MAX_TILT_RAD), np.bool_
    )


def _sign(lines: Lines, k: int, views: list[Posed], track: tuple[I64, I64]) -> float:
    """1 where segments run along the direction, which tells their brighter side, else -1."""
    total = 0.0
    for v, s in zip(*track, strict=True):
        T = views[v].T_cam_lines
        p = T[:3, :3] @ lines.point[k] + T[:3, 3]
        d = T[:3, :3] @ lines.direction[k]
        run = d[:2] * p[2] - p[:2] * d[2]  # of the projection, times the squared depth
        total += float(np.sign(run @ views[v].drawn.segments.direction[s]))
    return 1.0 if total >= 0.0 else -1.0


def _turned(lines: Lines, span: F64, signs: F64) -> tuple[Lines, F64]:
    """Lines with their directions turned about where a sign is negative."""
    # The vectors across do not turn the same way: both axes of shifts, or of tilts, may.
    direction = signs * lines.direction
    turn = np.einsum("nai,nbi->nab", across(direction), across(lines.direction))
    both = np.zeros((len(turn), 4, 4))
    both[:, :2, :2] = turn
    both[:, 2:, 2:] = signs[:, :, None] * turn
    covariance = both @ lines.covariance @ both.transpose(0, 2, 1)
    flipped = np.where(signs > 0.0, span, -span[:, ::-1])
    return Lines(lines.point, direction, covariance), flipped
