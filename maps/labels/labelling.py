# SPDX-License-Identifier: Apache-2.0
"""Lets a segmentation model look at the images of a map, and makes labels of what it sees."""

import hashlib
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import NamedTuple

import cv2
import msgspec
import numpy as np

from edge.cameras.recording import Recording, open_recording
from edge.changes.cover import holds
from edge.changes.glimpse import Ranger, glimpses
from edge.config.segmenter import SegmenterConfig
from edge.errors import ModelRefused, RecordingError
from edge.geometry import se3
from edge.segmenter.process import SegmenterProcess
from edge.tiles.manifest import LabelsEntry
from edge.types import F32, F64, I32, U8, Detections, Mask, Mat4
from maps.describe import Description
from maps.labels.layer import LabelSet, Seen
from maps.labels.objects import View, group_objects
from maps.labels.votes import LabelVotes
from maps.points import StoredPoints
from maps.progress import progress
from maps.views import ViewSet

# Weaker things make no object, but what was seen weakly here is not new there.
WEAK_SCORE = 0.1
_POLL_S = 0.5
_MIN_KNOWN = 2  # points in a mask, to tell its distance
_EDGE_PX = 4  # of a mask, that may be beside the thing
_DEPTH_SIGMA = 0.1  # of it, as the median of points says
_DEPTH_STEP = 8  # of a depth image that tells what hides what [px]


class _Image(NamedTuple):
    """One image of the map, and what the model saw in it."""

    detections: Detections
    depth_m: F32 | None  # (h, w), 0 where unknown


def label(
    model: Path,
    config: SegmenterConfig,
    chosen: ViewSet,
    descriptions: list[Description],
    stored: StoredPoints,
) -> LabelSet:
    """The labels of a map; ModelRefused or RecordingError says what is wrong."""
    views, seen = [], []
    runner = _Runner(model, config)
    votes: LabelVotes | None = None
    with closing(runner):
        images = progress(_look(runner, chosen), len(chosen.views), "labels")
        for k, image in enumerate(images):
            if votes is None:
                votes = LabelVotes(len(stored.xyz), len(runner.names))
            weak, strong = image.detections, _strong(image.detections, config.min_score)
            seen.append(Seen(weak.boxes, weak.classes, weak.scores))
            view = _view(k, chosen, descriptions[k], stored, image._replace(detections=strong))
            votes.add(view.points, view.pixels, strong)
            views.append(view)
    assert votes is not None
    entry = LabelsEntry(
        model=model.name,
        sha256=hashlib.sha256(model.read_bytes()).hexdigest(),
        names=list(runner.names),
    )
    return LabelSet(entry, votes.count(), seen, group_objects(views))


class _Runner:
    """The model's process, waited for."""

    def __init__(self, model: Path, config: SegmenterConfig) -> None:
        self._model = model
        self._config = msgspec.structs.replace(config, min_score=min(WEAK_SCORE, config.min_score))
        self._process: SegmenterProcess | None = None
        self._shape: tuple[int, ...] = ()
        self.names: tuple[str, ...] = ()

    def segment(self, image: U8) -> Detections:
        """What the model sees; ModelRefused where it gives nothing."""
        process = self._ready(image.shape)
        process.offer(1, image)
        while process.status.state == "busy":
            if (found := process.poll(_POLL_S)) is not None:
                return found.detections
        raise ModelRefused(f"{self._model}: {process.status.reason}")

    def close(self) -> None:
        """End the process."""
        if self._process is not None:
            self._process.close()

    def _ready(self, shape: tuple[int, ...]) -> SegmenterProcess:
        if self._process is None or shape != self._shape:
            self.close()
            self._shape = shape
            self._process = SegmenterProcess(self._model, shape, self._config)
            while self._process.status.state == "starting":
                self._process.poll(_POLL_S)
        process = self._process
        if process.status.state != "ready" or process.contract is None:
            raise ModelRefused(process.status.reason)
        self.names = process.contract.names
        return process


def _look(runner: _Runner, chosen: ViewSet) -> Iterator[_Image]:
    recordings = [open_recording(root) for root in chosen.roots]
    for view in chosen.views:
        recording = recordings[view.sequence]
        image = recording.colour(view.image)
        if image is None:
            raise RecordingError(f"{recording.root}: image {view.image} cannot be read any more")
        yield _Image(runner.segment(image), _depth(recording, chosen, view.sequence, view.image))


def _depth(recording: Recording, chosen: ViewSet, sequence: int, image: int) -> F32 | None:
    depth = recording.depth(image)
    if depth is None or not chosen.origin.depth_scale:
        return depth
    scaled: F32 = depth * np.float32(chosen.origin.depth_scale[sequence])
    return scaled


def _strong(detections: Detections, score: float) -> Detections:
    kept = np.flatnonzero(detections.scores >= score)
    return Detections(
        detections.boxes[kept],
        detections.scores[kept],
        detections.classes[kept],
        tuple(detections.masks[i] for i in kept),
    )


def _view(
    k: int, chosen: ViewSet, described: Description, stored: StoredPoints, image: _Image
) -> View:
    taken = chosen.views[k]
    camera, T_map_cam = chosen.cameras[taken.camera], taken.T_map_cam
    points: I32 = stored.point[k]
    pixels = described.features.raw_pixels[stored.features[k]]
    depth = _depths(stored.xyz[points], T_map_cam)
    if image.depth_m is None:
        ranger = _by_points(pixels, depth)
        surface_pixels, surface = pixels, depth
    else:
        ranger = _by_image(image.depth_m)
        surface_pixels, surface = _sampled(image.depth_m)
    lines = glimpses(image.detections, T_map_cam, camera, ranger)
    return View(points, pixels, T_map_cam, camera, image.detections, lines, surface_pixels, surface)


def _depths(xyz: F64, T_map_cam: Mat4) -> F64:
    depth: F64 = se3.transform(se3.inverse(T_map_cam), xyz)[:, 2]
    return depth


def _by_points(pixels: F32, depth_m: F64) -> Ranger:
    def ranger(mask: Mask) -> tuple[float, float]:
        inside = depth_m[holds(_inner(mask), pixels)]
        if len(inside) < _MIN_KNOWN:
            return float("nan"), float("nan")
        middle = float(np.median(inside))
        return middle, _DEPTH_SIGMA * middle

    return ranger


def _inner(mask: Mask) -> Mask:
    """The mask without its edge, where points of what is behind lie under it."""
    size = np.ones((2 * _EDGE_PX + 1, 2 * _EDGE_PX + 1), np.uint8)
    inner = cv2.erode(np.pad(mask.inside.astype(np.uint8), 1), size)[1:-1, 1:-1]
    return mask._replace(inside=inner > 0)


def _by_image(depth_m: F32) -> Ranger:
    def ranger(mask: Mask) -> tuple[float, float]:
        h, w = mask.inside.shape
        part = depth_m[mask.top : mask.top + h, mask.left : mask.left + w]
        known = part[mask.inside & (part > 0.0)]
        if len(known) == 0:
            return float("nan"), float("nan")
        middle = float(np.median(known))
        return middle, 0.5 * float(np.percentile(known, 75) - np.percentile(known, 25)) + 0.01

    return ranger


def _sampled(depth_m: F32) -> tuple[F32, F64]:
    rows, columns = np.mgrid[0 : depth_m.shape[0] : _DEPTH_STEP, 0 : depth_m.shape[1] : _DEPTH_STEP]
    depth = depth_m[rows, columns]
    known = depth > 0.0
    pixels = np.stack([columns[known], rows[known]], axis=1).astype(np.float32)
    return pixels, depth[known].astype(np.float64)
