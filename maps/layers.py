# SPDX-License-Identifier: Apache-2.0
"""The arrays of one tile, as FORMAT.md names them."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edge.errors import OutputError
from edge.tiles.format import Array
from edge.types import F64, I32
from maps.describe import Description
from maps.extra import ExtraLayer
from maps.points import StoredPoints
from maps.postings import MAX_KEYFRAMES, invert
from maps.views import View

I64 = NDArray[np.int64]

_MIN_SHARED = 8  # points, for two keyframes to count as seeing the same
_MAX_COVISIBLE = 30


class Places(NamedTuple):
    """Where each of some things is: its tile, and its index there."""

    tile: I32  # (n,)
    local: I32  # (n,)


class TileContent(NamedTuple):
    """What one tile is cut from."""

    number: int
    keyframes: I64  # views of this tile
    points: I64  # points of this tile
    origin: F64  # (3,)
    views: list[View]
    descriptions: list[Description]
    stored: StoredPoints
    keyframe_places: Places
    point_places: Places
    extra: tuple[ExtraLayer, ...] = ()


class _Links:
    """References into other tiles: each gets a row, once."""

    def __init__(self) -> None:
        self._row: dict[tuple[int, int], int] = {}

    def row(self, tile: int, local: int) -> int:
        return self._row.setdefault((tile, local), len(self._row))

    def table(self) -> NDArray[np.uint32]:
        return np.array(list(self._row), np.uint32).reshape(-1, 2)


def tile_layers(content: TileContent, n_words: int) -> dict[str, Array]:
    """All layers of a tile, in the order of the file: what opening and retrieval touch is first."""
    if len(content.keyframes) > MAX_KEYFRAMES:
        raise OutputError(
            f"a tile would hold {len(content.keyframes)} keyframes, {MAX_KEYFRAMES} are the most; "
            "build with a smaller --tile-m"
        )
    keyframe_links, point_links = _Links(), _Links()
    layers = {
        **_keyframe_layers(content),
        **_feature_layers(content, point_links),
        **_point_layers(content, keyframe_links),
        **_covisibility_layers(content, keyframe_links),
        **_bow_layers(content, n_words),
        **_depth_layers(content),
        "links/keyframe": keyframe_links.table(),
        "links/point": point_links.table(),
    }
    ordered = dict(sorted(layers.items(), key=lambda layer: _place(layer[0])))
    for extra in content.extra:
        ordered.update(extra.arrays(content))
    return ordered


def _place(name: str) -> int:
    if name.startswith("keyframes/") or name.endswith("offsets"):
        return 0  # read when the map is opened
    if name.startswith(("bow/", "covisibility/", "links/")):
        return 1  # read by every query, wherever it is
    return 2


def _keyframe_layers(content: TileContent) -> dict[str, Array]:
    views = [content.views[k] for k in content.keyframes]
    return {
        "keyframes/T_map_cam": np.array([view.T_map_cam for view in views]),
        "keyframes/t_ns": np.array([view.t_ns for view in views], np.int64),
        "keyframes/source": np.array([(view.sequence, view.image) for view in views], np.int32),
        "keyframes/camera": np.array([view.camera for view in views], np.uint8),
    }


def _feature_layers(content: TileContent, links: _Links) -> dict[str, Array]:
    stored, places = content.stored, content.point_places
    rows = [stored.features[k] for k in content.keyframes]
    features = [content.descriptions[k].features for k in content.keyframes]
    point = np.concatenate([stored.point[k] for k in content.keyframes])
    foreign = np.flatnonzero(places.tile[point] != content.number)
    reference = places.local[point].copy()
    for row in foreign:
        number = links.row(int(places.tile[point[row]]), int(places.local[point[row]]))
        reference[row] = -2 - number
    both = list(zip(features, rows, strict=True))
    angle = np.concatenate([f.angle_rad[r] for f, r in both])
    return {
        "features/offsets": _offsets([len(row) for row in rows]),
        "features/pixels": np.concatenate([f.pixels[r] for f, r in both]),
        "features/descriptors": np.concatenate([f.descriptors[r] for f, r in both]),
        "features/octave": np.concatenate([f.octave[r] for f, r in both]),
        "features/angle": (np.round(angle * (128.0 / np.pi)).astype(np.int64) % 256).astype(
            np.uint8
        ),
        "features/point": reference.astype(np.int32),
    }


def _point_layers(content: TileContent, links: _Links) -> dict[str, Array]:
    stored, chosen = content.stored, content.points
    counts = np.diff(stored.offsets)[chosen]
    starts = stored.offsets[chosen]
    rows = np.repeat(starts - np.cumsum(counts) + counts, counts) + np.arange(counts.sum())
    return {
        "points/xyz": (stored.xyz[chosen] - content.origin).astype(np.float32),
        "points/sigma": stored.lower[chosen].astype(np.float32),
        "points/direction": stored.direction[chosen].astype(np.float16),
        "points/half_angle": stored.half_angle_rad[chosen].astype(np.float16),
        "points/parallax": stored.parallax_rad[chosen].astype(np.float16),
        "points/pixel_size": stored.pixel_size[chosen].astype(np.float32),
        "points/n_views": np.minimum(stored.n_views[chosen], 65535).astype(np.uint16),
        "points/view_offsets": _offsets(counts.tolist()),
        "points/view_keyframe": _references(content, stored.view[rows], links),
        "points/view_feature": stored.stored[rows].astype(np.uint16),
    }


def _covisibility_layers(content: TileContent, links: _Links) -> dict[str, Array]:
    stored = content.stored
    others, shared, counts = [np.empty(0, np.int32)], [np.empty(0, np.uint16)], []
    for k in content.keyframes:
        points = stored.point[k]
        starts, ends = stored.offsets[points], stored.offsets[points + 1]
        seen = [stored.view[a:b] for a, b in zip(starts, ends, strict=True)]
        count = np.bincount(np.concatenate([np.empty(0, np.int32), *seen]), minlength=1)
        count[k : k + 1] = 0
        best = np.argsort(-count, kind="stable")[:_MAX_COVISIBLE]
        best = best[count[best] >= _MIN_SHARED]
        others.append(best.astype(np.int32))
        shared.append(np.minimum(count[best], 65535).astype(np.uint16))
        counts.append(len(best))
    return {
        "covisibility/offsets": _offsets(counts),
        "covisibility/keyframe": _references(content, np.concatenate(others), links),
        "covisibility/shared": np.concatenate(shared),
    }


def _bow_layers(content: TileContent, n_words: int) -> dict[str, Array]:
    postings = invert([content.descriptions[k].words for k in content.keyframes], n_words)
    return {
        "bow/offsets": postings.offsets,
        "bow/keyframe": postings.keyframe,
        "bow/weight": postings.weight,
    }


def _depth_layers(content: TileContent) -> dict[str, Array]:
    samples = [content.descriptions[k].samples for k in content.keyframes]
    return {
        "depth/offsets": _offsets([len(sample.pixels) for sample in samples]),
        "depth/pixels": np.concatenate([sample.pixels for sample in samples]),
        "depth/inverse": np.concatenate([sample.inverse_depth for sample in samples]),
        "depth/sigma": np.concatenate([sample.sigma for sample in samples]),
    }


def _references(content: TileContent, views: I32, links: _Links) -> NDArray[np.uint32]:
    """Keyframes as a tile stores them: its own by local index, others behind them by link."""
    places, own = content.keyframe_places, len(content.keyframes)
    references = places.local[views].astype(np.uint32)
    for row in np.flatnonzero(places.tile[views] != content.number):
        view = views[row]
        references[row] = own + links.row(int(places.tile[view]), int(places.local[view]))
    return references


def _offsets(counts: list[int]) -> NDArray[np.uint32]:
    return np.concatenate([[0], np.cumsum(counts)]).astype(np.uint32)
