# SPDX-License-Identifier: Apache-2.0
"""Compiles a map: images in, a map folder out."""

import logging
import os
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import cv2
import msgspec
import numpy as np

from edge import __version__
from edge.config.features import OrbConfig
from edge.config.segmenter import SegmenterConfig
from edge.errors import RecordingError
from edge.markers.finder import MarkerFinder
from edge.relocalise.bow import shipped_vocabulary
from edge.runtime.progress import progress
from edge.tiles import manifest as manifest_format
from edge.tiles.manifest import Bounds, Counts, Manifest, TileEntry, VocabularyEntry
from maps.assemble import assemble
from maps.depth.multiview import with_multiview_depth
from maps.describe import Description
from maps.extra import ExtraLayer, OwnTiles
from maps.fusion import Points
from maps.labels.labelling import label
from maps.labels.looking import Sightings, check_model, look_at
from maps.labels.moving import without_moving
from maps.learned import learned_layer, spec_of, survey_of
from maps.lens_build import Measured, with_refined_lenses
from maps.lines.build import line_layer
from maps.points import StoredPoints, store
from maps.pose_check import warn_of_wrong_poses
from maps.posing import BuildInput as BuildInput
from maps.posing import adapted, posed_views
from maps.settings import BuildSettings
from maps.shutter_build import with_rows_at_once
from maps.stored_markers import find_markers
from maps.survey import Survey
from maps.views import Origin, ViewSet
from maps.work_folder import work_folder
from maps.workers import open_workers
from maps.writer import check_not_source, check_target, new_map_folder, write_manifest, write_tile

log = logging.getLogger(__name__)


class BuildReport(NamedTuple):
    """What came out."""

    manifest: Manifest
    median_residual_px: float
    views_per_point: float
    skipped: int  # images without a pose
    origin: Origin  # of the poses
    readouts_s: dict[str, float]  # of rolling shutters that were found, by recording


def build(
    source: BuildInput,
    out: Path,
    settings: BuildSettings,
    extractor: OrbConfig | None = None,
    workers: int = 1,
    dask: str | None = None,
    segmenter: Path | None = None,
    features: Path | None = None,
) -> BuildReport:
    """Compile the map and write it to the folder `out`, labelled where there is a `segmenter`.

    A model named by `features` describes the same views beside ORB.

    The same input gives the same bytes, however many `workers` (processes, or those of a Dask
    scheduler's address) share the work.
    """
    check_target(out)
    check_not_source(out, *source.sequences)
    _check_distinct(source.sequences)
    orb = extractor or OrbConfig()
    learned = None
    if features is not None:
        learned = spec_of(features, orb)
        settings = msgspec.structs.replace(settings, features=features.name)
    # What is no good is refused before hours of work, not after.
    if settings.markers:
        MarkerFinder(settings.markers)
    if segmenter is not None:
        check_model(segmenter, SegmenterConfig(), source.sequences[0])
    with open_workers(workers, dask) as crew, work_folder(out) as work:
        survey = Survey(orb, crew, work)
        chosen = posed_views(source, settings, survey, workers)
        seen = None if segmenter is None else look_at(segmenter, SegmenterConfig(), chosen)
        measured = _measure(chosen, survey, settings, seen)
        layer = None
        if learned is not None:
            own = survey_of(learned, survey)
            layer = learned_layer(measured.chosen, measured.descriptions, own, settings, seen)
        return write_map(measured, out, settings, orb, seen, survey, layer)


def _check_distinct(sequences: list[Path]) -> None:
    """RecordingError where one comes twice: an image would confirm itself."""
    seen = set()
    for sequence in sequences:
        place = os.path.realpath(sequence)
        if place in seen:
            raise RecordingError(f"{sequence}: is named twice; name each sequence once")
        seen.add(place)


def _text(name: str) -> str:
    """A file's name as text, whatever its bytes are."""
    return name.encode(errors="backslashreplace").decode()


def write_map(
    measured: Measured,
    out: Path,
    settings: BuildSettings,
    extractor: OrbConfig,
    seen: Sightings | None = None,
    survey: Survey | None = None,
    learned: OwnTiles | None = None,
) -> BuildReport:
    """Write what was measured as the map `out`; lines, if asked for, are found by the `survey`."""
    chosen, descriptions, sides, points = measured
    if len(points.xyz) == 0:
        raise RecordingError(
            f"{chosen.roots[0]}: no point is seen from two places among {len(chosen.views)} "
            "images; take more images, moved sideways, or give depth"
        )
    poses = [view.T_map_cam for view in chosen.views]
    stored = store(points, poses, sides, settings.max_stored_features)
    labels = None
    if seen is not None:
        labels = label(seen, chosen, descriptions, stored)
    with new_map_folder(out) as folder:
        extra: tuple[ExtraLayer, ...] = () if labels is None else (labels,)
        if settings.lines and survey is not None:
            extra = (*extra, line_layer(chosen, stored, survey))
        entries = list(_write_tiles(folder, chosen, descriptions, stored, settings, extra))
        manifest = _manifest(chosen, entries, stored, points, settings, extractor)
        markers = find_markers(chosen, settings.markers) if settings.markers else []
        manifest = msgspec.structs.replace(
            manifest,
            labels=labels and labels.entry,
            markers=markers,
            learned=learned and learned.write(folder, settings.tile_m),
        )
        write_manifest(folder, manifest)
    return BuildReport(
        manifest,
        float(np.median(points.residual_px)),
        float(np.diff(stored.offsets).mean()),
        chosen.skipped,
        chosen.origin,
        {_text(chosen.roots[sequence].name): r for (sequence, _), r in chosen.readouts.items()},
    )


def _measure(
    chosen: ViewSet, survey: Survey, settings: BuildSettings, seen: Sightings | None = None
) -> Measured:
    """Measure with the best cameras and all depths that the settings ask for.

    What moves by itself is left out where it was `seen`.
    """
    descriptions = without_moving(adapted(chosen, survey.describe(chosen, settings)), chosen, seen)
    if chosen.origin.poses == "given":
        warn_of_wrong_poses(chosen, descriptions, settings)
    first = survey.measure(chosen, descriptions, settings)
    measured, _ = with_refined_lenses(first, survey.measure, settings)
    # What the lens explains is none of the shutter's doing.
    at_once = with_rows_at_once(measured, survey.measure, settings)
    if at_once is not measured:
        measured, _ = with_refined_lenses(at_once, survey.measure, settings)
    if settings.depth == "multiview":
        chosen, descriptions, _, points = measured
        descriptions = with_multiview_depth(
            chosen, descriptions, points, settings, survey.workers, survey.work
        )
        descriptions = without_moving(descriptions, chosen, seen)
        measured = survey.measure(chosen, descriptions, settings)
    return measured


def _cameras(chosen: ViewSet) -> list[manifest_format.Camera]:
    """Entries of the cameras; a refined one names the calibration that it stands for."""
    entries = []
    for camera, given in zip(chosen.cameras, chosen.calibrations, strict=True):
        entry = manifest_format.camera_entry(camera)
        if camera != given:
            of_given = manifest_format.camera_entry(given).id
            entry = msgspec.structs.replace(entry, replaces=of_given)
        entries.append(entry)
    return entries


def _write_tiles(
    folder: Path,
    chosen: ViewSet,
    descriptions: list[Description],
    stored: StoredPoints,
    settings: BuildSettings,
    extra: tuple[ExtraLayer, ...],
) -> Iterator[TileEntry]:
    n_words = shipped_vocabulary().n_words
    tiles = assemble(chosen.views, descriptions, stored, settings.tile_m, n_words, extra)
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
        metric=chosen.origin.metric,
        T_local_map=None,
        tile_m=settings.tile_m,
        extractor=extractor,
        vocabulary=VocabularyEntry(id=vocabulary.id, words=vocabulary.n_words),
        cameras=_cameras(chosen),
        sequences=[_text(root.name) for root in chosen.roots],
        build={
            "poses": chosen.origin.poses,
            "scale": chosen.origin.scale,
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
