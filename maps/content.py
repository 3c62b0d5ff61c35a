# SPDX-License-Identifier: Apache-2.0
"""A map taken apart into what the compiler writes tiles from, and written again."""

import logging
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from edge import __version__
from edge.errors import TileError
from edge.relocalise.features import Features
from edge.tiles.index import BowVector
from edge.tiles.manifest import Bounds, Counts, Manifest
from edge.tiles.reader import Map
from edge.tiles.tile import LAYERS, OPTIONAL_LAYERS, Tile
from edge.types import F64, I32
from maps.assemble import assemble
from maps.describe import Description
from maps.extra import ExtraLayer, OwnTiles, Sizes
from maps.labels.layer import LabelSet
from maps.lines.layer import LineLayer
from maps.points import StoredPoints
from maps.views import View
from maps.writer import new_map_folder, write_manifest, write_tile

I64 = NDArray[np.int64]
log = logging.getLogger(__name__)

# What only some maps have, by the names of OPTIONAL_LAYERS.
KINDS: dict[str, type[ExtraLayer]] = {"labels": LabelSet, "lines": LineLayer}


class Content(NamedTuple):
    """All that a map holds, in one piece."""

    views: list[View]
    descriptions: list[Description]
    points: StoredPoints
    extra: dict[str, ExtraLayer] = {}  # noqa: RUF012  # never changed


def load(opened: Map) -> Content:
    """Everything in `opened`; its keyframes in the order of their images, as a build has them."""
    views, descriptions, seen = [], [], []
    known = LAYERS.keys() | {name for kind in KINDS for name in OPTIONAL_LAYERS[kind]}
    unknown = sorted({name for tile in opened.tiles for name in tile.layers if name not in known})
    if unknown:
        log.warning("layers not carried over: %s", ", ".join(unknown))
    words = [vector for tile in opened.tiles for vector in _words(tile)]
    order = np.lexsort(opened.keyframe_source.T[::-1]).astype(np.int32)
    for k in order.tolist():
        sequence, image = map(int, opened.keyframe_source[k])
        camera = int(opened.keyframe_camera[k])
        views.append(View(sequence, image, int(opened.keyframe_t_ns[k]), opened.pose(k), camera))
        stored = opened.features(k)
        n = len(stored.pixels)
        features = Features(
            stored.pixels, stored.descriptors, stored.octave, stored.angle_rad, stored.pixels
        )
        nothing = np.zeros(n)
        descriptions.append(
            Description(features, words[k], nothing, nothing, opened.depth_samples(k))
        )
        if n and stored.point.min() < 0:
            raise TileError(f"{opened.folder}: keyframe {k} has features without a point")
        seen.append(stored.point)
    extra = {name: kind.load(opened, order) for name, kind in KINDS.items()}
    there = {name: layer for name, layer in extra.items() if layer is not None}
    return Content(views, descriptions, _points(opened, seen), there)


def select(content: Content, keyframes: list[int]) -> Content:
    """The content that some keyframes, ascending, still see."""
    points, kept = content.points, np.array(keyframes, np.int64)
    number = np.full(len(content.views), -1, np.int32)
    number[kept] = np.arange(len(kept))
    rows = number[points.view] >= 0
    owner = np.repeat(np.arange(len(points.xyz)), np.diff(points.offsets))[rows]
    left, counts = np.unique(owner, return_counts=True)
    rank = np.full(len(points.xyz), -1, np.int32)
    rank[left] = np.arange(len(left))
    new = points._replace(
        **{name: getattr(points, name)[left] for name in _OF_POINTS},
        offsets=np.concatenate([[0], np.cumsum(counts)]),
        view=number[points.view[rows]],
        feature=points.feature[rows],
        stored=points.stored[rows],
        features=[points.features[k] for k in keyframes],
        point=[rank[points.point[k]] for k in keyframes],
    )
    views = [content.views[k] for k in keyframes]
    extra = {name: layer.kept(number, rank) for name, layer in content.extra.items()}
    return Content(views, [content.descriptions[k] for k in keyframes], new, extra)


def join(first: Content, second: Content, sequences: int, cameras: list[int]) -> Content:
    """Both contents in one; the second's sequences come behind `sequences` of the first.

    cameras : index of each camera of the second content among those of both
    """
    a, b = first.points, second.points
    n, m = len(first.views), len(a.xyz)
    views = [
        view._replace(sequence=view.sequence + sequences, camera=cameras[view.camera])
        for view in second.views
    ]
    joined = a._replace(
        **{
            name: np.concatenate([getattr(a, name), getattr(b, name)])
            for name in (*_OF_POINTS, "feature", "stored")
        },
        offsets=np.concatenate([a.offsets, b.offsets[1:] + a.offsets[-1]]),
        view=np.concatenate([a.view, b.view + np.int32(n)]),
        features=[*a.features, *b.features],
        point=[*a.point, *(point + np.int32(m) for point in b.point)],
    )
    sizes = (Sizes(n, m), Sizes(len(second.views), len(b.xyz)))
    extra = {
        name: kind.joined(first.extra.get(name), second.extra.get(name), sizes)
        for name, kind in KINDS.items()
        if name in first.extra or name in second.extra
    }
    descriptions = [*first.descriptions, *second.descriptions]
    return Content([*first.views, *views], descriptions, joined, extra)


def write(
    content: Content, manifest: Manifest, out: Path, learned: OwnTiles | None = None
) -> Manifest:
    """Write the content as the map `out`, with what `manifest` says of its making."""
    tiles = assemble(
        content.views, content.descriptions, content.points, manifest.tile_m,
        manifest.vocabulary.words, tuple(content.extra[name] for name in sorted(content.extra)),
    )  # fmt: skip
    labels = content.extra.get("labels")
    with new_map_folder(out) as folder:
        entries = [write_tile(folder, number, tile) for number, tile in enumerate(tiles)]
        low = np.min([entry.bounds_m.min for entry in entries], axis=0).tolist()
        high = np.max([entry.bounds_m.max for entry in entries], axis=0).tolist()
        written = msgspec.structs.replace(
            manifest,
            writer=f"mapvo {__version__}",
            bounds_m=Bounds(min=tuple(low), max=tuple(high)),
            counts=Counts(
                keyframes=len(content.views),
                points=len(content.points.xyz),
                observations=len(content.points.view),
            ),
            tiles=entries,
            labels=labels.entry if isinstance(labels, LabelSet) else None,
            learned=None if learned is None else learned.write(folder, manifest.tile_m),
        )
        write_manifest(folder, written)
    return written


_OF_POINTS = (
    "xyz", "lower", "parallax_rad", "direction", "half_angle_rad", "pixel_size", "n_views",
)  # fmt: skip


def _words(tile: Tile) -> list[BowVector]:
    """Histogram of words of each keyframe of a tile."""
    offsets: I64 = tile["bow/offsets"].astype(np.int64)
    counts = offsets[1:] - offsets[:-1]
    word = np.repeat(np.arange(len(counts), dtype=np.int32), counts)
    keyframe = tile["bow/keyframe"].astype(np.int64)
    order = np.argsort(keyframe, kind="stable")  # words stay ascending
    borders = np.searchsorted(keyframe[order], np.arange(1, tile.entry.keyframes))
    rows = np.split(order, borders)
    return [BowVector(word[row], tile["bow/weight"][row]) for row in rows]


def _points(opened: Map, seen: list[I32]) -> StoredPoints:
    """All points with their views, in the order of the map."""
    owner = np.concatenate([np.empty(0, np.int32), *seen])
    view = np.repeat(np.arange(len(seen), dtype=np.int32), [len(points) for points in seen])
    feature = np.concatenate(
        [np.empty(0, np.int32), *(np.arange(len(points), dtype=np.int32) for points in seen)]
    )
    order = np.argsort(owner, kind="stable")  # the views of each stay ascending
    counts = np.bincount(owner, minlength=opened.n_points)
    if np.any(counts == 0):
        raise TileError(f"{opened.folder}: a point is seen by no keyframe; build the map again")
    found = opened.points(np.arange(opened.n_points, dtype=np.int32))
    lower = np.concatenate([tile["points/sigma"] for tile in opened.tiles]).astype(np.float64)
    return StoredPoints(
        xyz=found.xyz,
        lower=lower,
        parallax_rad=_f64(found.parallax_rad),
        direction=_f64(found.direction),
        half_angle_rad=_f64(found.half_angle_rad),
        pixel_size=_f64(found.pixel_size),
        n_views=found.n_views.astype(np.int64),
        offsets=np.concatenate([[0], np.cumsum(counts)]),
        view=view[order],
        feature=feature[order],
        stored=feature[order],
        features=[np.arange(len(points), dtype=np.int32) for points in seen],
        point=seen,
    )


def _f64(values: object) -> F64:
    return np.asarray(values, np.float64)
