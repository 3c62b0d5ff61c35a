# SPDX-License-Identifier: Apache-2.0
"""A map of made-up points, written as the compiler writes it: exact, and in several tiles."""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from edge.config.features import OrbConfig
from edge.relocalise.bow import shipped_vocabulary
from edge.relocalise.features import Features
from edge.tiles import manifest as manifest_format
from edge.tiles.manifest import Bounds, Counts, Manifest, VocabularyEntry
from edge.types import DepthSamples
from maps.assemble import assemble
from maps.describe import Description
from maps.fusion import Accuracy, Points
from maps.matching import MatchSide, match_side
from maps.points import StoredPoints, store
from maps.views import View
from maps.writer import new_map_folder, write_manifest, write_tile
from tests.maps.wall_drive import CAMERA

N_KEYFRAMES = 7
N_POINTS = 150
SPACING_M = 1.0


class SmallMap(NamedTuple):
    """The truth behind the files."""

    folder: Path
    views: list[View]
    descriptions: list[Description]
    points: Points
    stored: StoredPoints


@contextmanager
def edited_manifest(folder: Path) -> Iterator[dict[str, Any]]:
    """The manifest of a map, to be changed; it is written back without its checksum."""
    path = folder / manifest_format.FILE_NAME
    table = json.loads(path.read_bytes())
    table.pop("checksum", None)
    yield table
    path.write_text(json.dumps(table))


def write_small_map(folder: Path, tile_m: float = 2.0, seed: int = 0) -> SmallMap:
    """Seven keyframes in a row, each seeing what its neighbours see."""
    rng = np.random.default_rng(seed)
    views, poses = [], []
    for k in range(N_KEYFRAMES):
        T = np.eye(4)
        T[:3, 3] = (SPACING_M * k, 0.1 * k, 0.0)
        poses.append(T)
        views.append(View(0, 10 * k, 1_000_000_000 * k, T, 0))
    x = rng.uniform(-1.0, SPACING_M * N_KEYFRAMES, N_POINTS)
    xyz = np.stack((x, rng.uniform(-1, 1, N_POINTS), rng.uniform(2, 4, N_POINTS)), axis=1)
    sees = [np.flatnonzero(np.abs(xyz[:, 0] - SPACING_M * k) < 1.4) for k in range(N_KEYFRAMES)]
    # Features lie in an order of their own, with some that are no point in between.
    feature_of = [rng.permutation(len(seen) + 5)[: len(seen)] for seen in sees]
    descriptions = [_describe(len(seen) + 5, rng) for seen in sees]
    rows = sorted(
        (int(point), k, int(feature))
        for k in range(N_KEYFRAMES)
        for point, feature in zip(sees[k], feature_of[k], strict=True)
    )
    owner, view, feature = np.array(rows).T
    present, counts = np.unique(owner, return_counts=True)
    factor = rng.normal(0.0, 0.01, (len(present), 3, 3))
    points = Points(
        xyz=xyz[present],
        covariance=factor @ factor.transpose(0, 2, 1) + 1e-6 * np.eye(3),
        parallax_rad=rng.uniform(0.01, 0.5, len(present)),
        offsets=np.concatenate([[0], np.cumsum(counts)]),
        view=view.astype(np.int32),
        feature=feature.astype(np.int32),
        residual_px=np.zeros(len(rows)),
        accuracy=Accuracy(0.5, 0.1),
    )
    sides = [_side(described) for described in descriptions]
    stored = store(points, poses, sides, 1000)
    _write(folder, views, descriptions, stored, tile_m)
    return SmallMap(folder, views, descriptions, points, stored)


def _describe(n: int, rng: np.random.Generator) -> Description:
    pixels = rng.uniform((0, 0), (CAMERA.width, CAMERA.height), (n, 2)).astype(np.float32)
    descriptors = rng.integers(0, 256, (n, 32)).astype(np.uint8)
    features = Features(
        pixels,
        descriptors,
        rng.integers(0, 8, n).astype(np.uint8),
        rng.uniform(0, 2 * np.pi, n).astype(np.float32),
        pixels,
    )
    words = shipped_vocabulary().describe(descriptors)
    positive = rng.uniform(0.1, 1.0, (2, n)).astype(np.float32)
    return Description(features, words, np.zeros(n), np.zeros(n), DepthSamples(pixels, *positive))


def _side(described: Description) -> MatchSide:
    return match_side(
        described.features, CAMERA.pinhole, OrbConfig(), described.depth, described.depth_sigma
    )


def _write(
    folder: Path,
    views: list[View],
    descriptions: list[Description],
    stored: StoredPoints,
    tile_m: float,
) -> None:
    vocabulary = shipped_vocabulary()
    tiles = assemble(views, descriptions, stored, tile_m, vocabulary.n_words)
    with new_map_folder(folder) as partial:
        entries = [write_tile(partial, number, tile) for number, tile in enumerate(tiles)]
        manifest = Manifest(
            format=manifest_format.FORMAT,
            version=manifest_format.VERSION,
            writer="test",
            opencv="0",
            frame="map",
            metric=True,
            T_local_map=None,
            tile_m=tile_m,
            extractor=OrbConfig(),
            vocabulary=VocabularyEntry(id=vocabulary.id, words=vocabulary.n_words),
            cameras=[manifest_format.camera_entry(CAMERA)],
            sequences=["made up"],
            build={},
            bounds_m=Bounds(min=(-9.0, -9.0, -9.0), max=(9.0, 9.0, 9.0)),
            counts=Counts(
                keyframes=len(views), points=len(stored.xyz), observations=len(stored.view)
            ),
            tiles=entries,
        )
        write_manifest(partial, manifest)
