# SPDX-License-Identifier: Apache-2.0
"""Lets a segmentation model look at the images of a map."""

import hashlib
from contextlib import closing
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np

from edge.cameras.recording import open_recording
from edge.config.segmenter import SegmenterConfig
from edge.errors import ModelRefused, RecordingError
from edge.runtime.progress import progress
from edge.segmenter.process import SegmenterProcess
from edge.tiles.manifest import LabelsEntry
from edge.types import F32, I32, U8, Detections, Mask
from maps.views import ViewSet

# Weaker things make no object, but what was seen weakly here is not new there.
WEAK_SCORE = 0.1
_POLL_S = 0.5


class _Kept(NamedTuple):
    """What was seen in one view, its masks as bits."""

    boxes: F32
    scores: F32
    classes: I32
    masks: list[tuple[int, int, tuple[int, int], U8]]  # left, top, shape, bits


class Sightings:
    """What a model saw in each view of a map."""

    def __init__(self, entry: LabelsEntry, config: SegmenterConfig, seen: list[_Kept]) -> None:
        self.entry, self.config = entry, config
        self._seen = seen

    def weak(self, k: int) -> Detections:
        """Everything that was seen in view `k`."""
        kept = self._seen[k]
        return Detections(kept.boxes, kept.scores, kept.classes, _masks(kept))

    def strong(self, k: int) -> Detections:
        """What the model was sure enough of in view `k`."""
        weak = self.weak(k)
        kept = np.flatnonzero(weak.scores >= self.config.min_score)
        return Detections(
            weak.boxes[kept], weak.scores[kept], weak.classes[kept],
            tuple(weak.masks[i] for i in kept),
        )  # fmt: skip

    def moving(self, k: int) -> list[Mask]:
        """Masks of view `k` that are of things that move by themselves."""
        seen, names = self.strong(k), self.entry.names
        return [
            mask
            for label, mask in zip(seen.classes.tolist(), seen.masks, strict=True)
            if names[label] in self.config.moving
        ]


def _pack(seen: Detections) -> _Kept:
    masks = [(m.left, m.top, m.inside.shape, np.packbits(m.inside)) for m in seen.masks]
    return _Kept(seen.boxes, seen.scores, seen.classes, masks)


def _masks(kept: _Kept) -> tuple[Mask, ...]:
    return tuple(
        Mask(left, top, np.unpackbits(bits, count=h * w).reshape(h, w).astype(bool))
        for left, top, (h, w), bits in kept.masks
    )


def look_at(model: Path, config: SegmenterConfig, chosen: ViewSet) -> Sightings:
    """What the model sees in all views; ModelRefused or RecordingError says what is wrong."""
    runner = _Runner(model, config)
    recordings = [open_recording(root) for root in chosen.roots]
    found: list[_Kept] = []
    with closing(runner):
        for view in progress(chosen.views, len(chosen.views), "labels"):
            image = recordings[view.sequence].colour(view.image)
            if image is None:
                raise RecordingError(
                    f"{recordings[view.sequence].root}: image {view.image} cannot be read any more"
                )
            found.append(_pack(runner.segment(image)))
    entry = LabelsEntry(
        model=model.name,
        sha256=hashlib.sha256(model.read_bytes()).hexdigest(),
        names=list(runner.names),
    )
    return Sightings(entry, config, found)


def check_model(model: Path, config: SegmenterConfig, sequence: Path) -> None:
    """ModelRefused where the model takes no images as large as those of the sequence."""
    camera = open_recording(sequence).cameras[0]
    with closing(_Runner(model, config)) as runner:
        runner.ready((camera.height, camera.width, 3))


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
        process = self.ready(image.shape)
        process.offer(1, image)
        while process.status.state == "busy":
            if (found := process.poll(_POLL_S)) is not None:
                return found.detections
        raise ModelRefused(f"{self._model}: {process.status.reason}")

    def close(self) -> None:
        """End the process."""
        if self._process is not None:
            self._process.close()

    def ready(self, shape: tuple[int, ...]) -> SegmenterProcess:
        """The process for images of this shape; ModelRefused where it does not start."""
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
