# SPDX-License-Identifier: Apache-2.0
"""Compiles a map: posed images in, a map folder out."""

import logging
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import cv2
import msgspec
import numpy as np

from edge import __version__
from edge.config.features import OrbConfig
from edge.errors import RecordingError
from edge.geometry import se3
from edge.geometry.camera import CameraModel
from edge.relocalise.bow import shipped_vocabulary
from edge.tiles import manifest as manifest_format
from edge.tiles.manifest import Bounds, Counts, Manifest, TileEntry, VocabularyEntry
from maps.assemble import assemble
from maps.describe import Description
from maps.fusion import Points, fuse
from maps.lens_build import Measured, with_refined_lenses
from maps.matching import Matches, MatchSide, match, match_side
from maps.pairs import choose_pairs
from maps.points import StoredPoints, store
from maps.progress import progress
from maps.settings import BuildSettings
from maps.tracks import join
from maps.views import ViewSet, choose_views
from maps.workers import describe_all, map_threads
from maps.writer import check_target, new_map_folder, write_manifest, write_tile

log = logging.getLogger(__name__)


class BuildInput(NamedTuple):
    """What a map is built from."""

    sequences: list[Path]
    frames: slice | None = None
    every: int = 1
    exclude: frozenset[int] = frozenset()


class BuildReport(NamedTuple):
    """What came out."""

    manifest: Manifest
    median_residual_px: float
    views_per_point: float
    skipped: int  # images without a pose


def build(
    source: BuildInput,
    out: Path,
    settings: BuildSettings,
    extractor: OrbConfig | None = None,
    workers: int = 1,
) -> BuildReport:
    """Compile the map and write it to the folder `out`.

    The same input gives the same bytes, however many workers share the work.
    """
    check_target(out)
    orb = extractor or OrbConfig()
    chosen = choose_views(source.sequences, source.frames, source.every, source.exclude)

    def measure(
        chosen: ViewSet, descriptions: list[Description], settings: BuildSettings
    ) -> Measured:
        sides = _sides(chosen, descriptions, orb)
        points = _reconstruct(chosen, descriptions, sides, settings, workers)
        return Measured(chosen, descriptions, sides, points)

    described = _describe(chosen, orb, settings, workers)
    first = measure(chosen, described, settings)
    measured, replaced = with_refined_lenses(first, measure, settings)
    chosen, descriptions, sides, points = measured
    if len(points.xyz) == 0:
        raise RecordingError(
            f"{chosen.roots[0]}: no point is seen from two places among {len(chosen.views)} "
            "images; take more images, moved sideways, or give depth"
        )
    poses = [view.T_map_cam for view in chosen.views]
    stored = store(points, poses, sides, settings.max_stored_features)
    with new_map_folder(out) as folder:
        entries = list(_write_tiles(folder, chosen, descriptions, stored, settings))
        manifest = _manifest(chosen, entries, stored, points, settings, orb)
        manifest = msgspec.structs.replace(manifest, cameras=_cameras(chosen.cameras, replaced))
        write_manifest(folder, manifest)
    return BuildReport(
        manifest,
        float(np.median(points.residual_px)),
        float(np.diff(stored.offsets).mean()),
        chosen.skipped,
    )


def _cameras(
    cameras: list[CameraModel], replaced: dict[int, CameraModel]
) -> list[manifest_format.Camera]:
    """Entries of the cameras; a refined one names the calibration that it stands for."""
    entries = [manifest_format.camera_entry(camera) for camera in cameras]
    for camera, given in replaced.items():
        of_given = manifest_format.camera_entry(given).id
        entries[camera] = msgspec.structs.replace(entries[camera], replaces=of_given)
    return entries


def _describe(
    chosen: ViewSet, extractor: OrbConfig, settings: BuildSettings, workers: int
) -> list[Description]:
    described = describe_all(chosen.roots, chosen.views, extractor, settings, workers)
    return list(progress(described, len(chosen.views), "images"))


def _sides(
    chosen: ViewSet, descriptions: list[Description], extractor: OrbConfig
) -> list[MatchSide]:
    return [
        match_side(
            described.features,
            chosen.cameras[view.camera].pinhole,
            extractor,
            described.depth,
            described.depth_sigma,
        )
        for view, described in zip(chosen.views, descriptions, strict=True)
    ]


def _reconstruct(
    chosen: ViewSet,
    descriptions: list[Description],
    sides: list[MatchSide],
    settings: BuildSettings,
    workers: int,
) -> Points:
    poses = [view.T_map_cam for view in chosen.views]
    words = [described.words for described in descriptions]
    pairs = choose_pairs(poses, words, shipped_vocabulary().n_words, settings)

    def match_pair(pair: tuple[int, int]) -> tuple[int, int, Matches]:
        i, j = pair
        T_j_i = se3.inverse(poses[j]) @ poses[i]
        return i, j, match(sides[i], sides[j], T_j_i, settings)

    matched = progress(map_threads(match_pair, pairs, workers), len(pairs), "pairs")
    counts = [len(side.rays) for side in sides]
    tracks = join(counts, matched, [side.depth > 0.0 for side in sides])
    return fuse(tracks, poses, sides, settings)


def _write_tiles(
    folder: Path,
    chosen: ViewSet,
    descriptions: list[Description],
    stored: StoredPoints,
    settings: BuildSettings,
) -> Iterator[TileEntry]:
    n_words = shipped_vocabulary().n_words
    tiles = assemble(chosen.views, descriptions, stored, settings.tile_m, n_words)
    for number, tile in enumerate(progress(tiles, len(tiles), "tiles")):
        yield write_tile(folder, number, tile)


def _manifest(
    chosen: ViewSet,
    entries: list[TileEntry],
    stored: StoredPoints,
    points: Points,
    settings: BuildSettings,
    extractor: OrbConfig,
) -> Manifest:
    vocabulary = shipped_vocabulary()
    boxes = [entry.bounds_m for entry in entries]
    low = np.min([box.min for box in boxes], axis=0).tolist()
    high = np.max([box.max for box in boxes], axis=0).tolist()
    fields = {name: getattr(settings, name) for name in settings.__struct_fields__}
    return Manifest(
        format=manifest_format.FORMAT,
        version=manifest_format.VERSION,
        writer=f"mapvo {__version__}",
        opencv=cv2.__version__,
        frame="map",
        metric=True,
        T_local_map=None,
        tile_m=settings.tile_m,
        extractor=extractor,
        vocabulary=VocabularyEntry(id=vocabulary.id, words=vocabulary.n_words),
        cameras=[manifest_format.camera_entry(camera) for camera in chosen.cameras],
        sequences=[root.name for root in chosen.roots],
        build={
            "poses": "given",
            **fields,
            "measured_corner_px": round(points.accuracy.corner_px, 4),
            "measured_pose_px": round(points.accuracy.pose_px, 4),
        },
        bounds_m=Bounds(min=tuple(low), max=tuple(high)),
        counts=Counts(
            keyframes=len(chosen.views), points=len(stored.xyz), observations=len(stored.view)
        ),
        tiles=entries,
    )
