# SPDX-License-Identifier: Apache-2.0
"""Joins two maps of one frame."""

import logging
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np

from edge.errors import TileError
from edge.tiles.manifest import MAX_COUNT, Camera, Manifest, MarkerEntry
from edge.tiles.reader import Map, open_map
from edge.types import F64
from maps.content import Content, join, load, write
from maps.learned import LearnedLayer, load_layer
from maps.shared_points import look_alikes, shared_points, with_shared_points
from maps.writer import check_not_source

log = logging.getLogger(__name__)

_ASKED = 60  # keyframes of the second map, evenly spread
# Points of one corner lie together to so many deviations and this part of their distance.
_SIGMAS, _RELATIVE = 4.0, 0.02
_LEAST_AGREEING = 0.3  # of the matches of a place; wrong ones are among them


class Overlap(NamedTuple):
    """What two maps say of the places that both show."""

    places: int  # that both show
    agreeing: int  # whose points lie together
    apart_m: float  # median distance of matched points
    points: int = 0  # that both had, and that are one now


def merge(first: Path, second: Path, out: Path) -> tuple[Manifest, Overlap]:
    """Write a map of both; TileError where they cannot be one."""
    check_not_source(out, first, second)
    a, b = open_map(first), open_map(second)
    _check_alike(a, b)
    own, other = load(a), load(b)
    overlap = compare(a, other)
    if 2 * overlap.agreeing < overlap.places:
        raise TileError(
            f"{second}: is not in the frame of {first}: of {overlap.places} places that both show, "
            f"{overlap.places - overlap.agreeing} lie elsewhere ({overlap.apart_m:.2f} m in the "
            "median); build both from poses of one frame"
        )
    cameras, places = _cameras(a.manifest, b.manifest)
    content = join(own, other, len(a.manifest.sequences), places)
    if overlap.places:
        pairs = shared_points(a, other, [camera.pinhole for camera in b.cameras])
        overlap = overlap._replace(points=len(pairs))
        content = with_shared_points(content, pairs + np.array((0, len(own.points.xyz)), np.int32))
    if len(content.points.view) > MAX_COUNT:
        raise TileError(f"{second}: both maps together are too large for one")
    learned = _learned(a, b, places)
    return write(content, _manifest(a.manifest, b.manifest, cameras), out, learned), overlap


def compare(a: Map, content: Content) -> Overlap:
    """Whether places that look alike in both maps lie at the same place."""
    asked = np.unique(np.linspace(0, len(content.views) - 1, _ASKED).astype(int))
    distances, agreeing = [], 0
    for k in asked.tolist():
        found = _distances(a, content, k)
        if found is None:
            continue
        off, limit = found
        distances.append(float(np.median(off)))
        agreeing += int(np.mean(off < limit) > _LEAST_AGREEING)
    apart = float(np.median(distances)) if distances else 0.0
    return Overlap(len(distances), agreeing, apart)


def _distances(a: Map, content: Content, k: int) -> tuple[F64, F64] | None:
    """How far the points of keyframe `k` are from those that look the same, and may be."""
    found = look_alikes(a, content, k, 1)
    if not found:
        return None
    (alike,) = found
    points = content.points
    mine = points.point[k][alike.second]
    matched = a.points(a.features(alike.keyframe).point[alike.first])
    off = np.linalg.norm(points.xyz[mine] - matched.xyz, axis=1)
    # The trace bounds the largest variance.
    variance = np.einsum("ni,ni->n", points.lower[mine], points.lower[mine])
    variance += np.einsum("nii->n", matched.covariance)
    distance = np.linalg.norm(points.xyz[mine] - content.views[k].T_map_cam[:3, 3], axis=1)
    return off, _SIGMAS * np.sqrt(variance) + _RELATIVE * distance


def _learned(a: Map, b: Map, cameras: list[int]) -> LearnedLayer | None:
    """The learned features of both, if both have them of one model."""
    one, other = load_layer(a), load_layer(b)
    both = None
    if one is not None and other is not None:
        both = one.joined(other, len(a.manifest.sequences), cameras)
    if both is None and (one or other):
        log.warning("learned features not carried over: the maps have not both those of one model")
    return both


def _check_alike(a: Map, b: Map) -> None:
    """TileError where the maps' numbers mean different things."""
    one, other = a.manifest, b.manifest
    for what, same in {
        "vocabulary": one.vocabulary.id == other.vocabulary.id,
        "extractor": one.extractor == other.extractor,
        "unit (metric)": one.metric == other.metric,
        "frame": one.frame == other.frame,
        "T_local_map": _same_place(one.T_local_map, other.T_local_map),
    }.items():
        if not same:
            raise TileError(
                f"{b.folder}: has another {what} than {a.folder}; build or align both alike"
            )


def _same_place(one: list[list[float]] | None, other: list[list[float]] | None) -> bool:
    return one is None or other is None or bool(np.allclose(one, other, atol=1e-6))


def _cameras(one: Manifest, other: Manifest) -> tuple[list[Camera], list[int]]:
    """Cameras of both, and where those of the second map are among them."""
    cameras = list(one.cameras)
    for camera in other.cameras:
        if camera not in cameras:
            cameras.append(camera)
    return cameras, [cameras.index(camera) for camera in other.cameras]


def _manifest(one: Manifest, other: Manifest, cameras: list[Camera]) -> Manifest:
    """The joint manifest, but for what writing fills in; settings that differ are left out."""
    build = {name: value for name, value in one.build.items() if other.build.get(name) == value}
    T = one.T_local_map if one.T_local_map is not None else other.T_local_map
    return msgspec.structs.replace(
        one,
        T_local_map=T,
        cameras=cameras,
        sequences=[*one.sequences, *other.sequences],
        build=build,
        markers=_markers(one, other),
    )


def _markers(one: Manifest, other: Manifest) -> list[MarkerEntry]:
    """Markers of both maps; of one that both have, the first map's place."""
    known = {(marker.family, marker.number) for marker in one.markers}
    new = [marker for marker in other.markers if (marker.family, marker.number) not in known]
    return [*one.markers, *new]
