# SPDX-License-Identifier: Apache-2.0
"""Gives frames to the model, and what it sees to the search for changes."""

import logging
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

import msgspec
import numpy as np

from edge.config import Config
from edge.errors import ModelRefused
from edge.geometry.camera import CameraModel
from edge.runtime.change_link import Order
from edge.runtime.change_process import ChangeProcess
from edge.runtime.sights import UNPLACED, Sight, colour_of
from edge.segmenter.process import SegmenterProcess
from edge.tiles.reader import Map
from edge.types import F64, Bools, ChangeEvent, Detections, Frame, Look, Moving

if TYPE_CHECKING:
    from edge.changes.changes import Changes
    from edge.changes.unlabelled import UnlabelledChanges

log = logging.getLogger(__name__)

_Stage: TypeAlias = "Changes | UnlabelledChanges | ChangeProcess"
# As maps are labelled: so weak masks begin nothing, but tell of what surer ones began.
_FAINT_SCORE = 0.1
_POLL_S = 0.05
_WAIT_S = 0.2


class Watcher:
    """The model's process and the stage that it serves. Owned by one thread."""

    def __init__(
        self, config: Config, camera: CameraModel, map_: Map | None, *, apart: bool
    ) -> None:
        """`apart`: the stage works in a process of its own, so that no thread waits for it."""
        self._config, self._camera, self._map, self._apart = config, camera, map_, apart
        self.process: SegmenterProcess | None = None
        if config.segmenter.model:
            shape = (camera.height, camera.width, 3)
            least = min(_FAINT_SCORE, config.segmenter.min_score)
            asked = msgspec.structs.replace(config.segmenter, min_score=least)
            self.process = SegmenterProcess(Path(config.segmenter.model), shape, asked)
        self._stage: _Stage | None = None
        self._asked_for: tuple[Map | None, tuple[str, ...]] | None = None  # what the stage is for
        self._moving: Moving | None = None
        self._unplaced: deque[Look] = deque(maxlen=UNPLACED)  # their poses mean nothing yet

    @property
    def trouble(self) -> str:
        """Why the search for changes failed last; empty where all is well."""
        stage = self._stage  # its own thread may end it meanwhile
        return stage.reason if isinstance(stage, ChangeProcess) else ""

    def wait_until_ready(self) -> None:
        """Wait for the model; ModelRefused says why it cannot be used."""
        if self.process is None:
            return
        while self.process.status.state == "starting":
            self.process.poll(_WAIT_S)
        if self.process.status.state != "ready":
            raise ModelRefused(self.process.status.reason)

    def use_map(self, map_: Map, camera: CameraModel) -> None:
        """Look in another map from now on."""
        self._map, self._camera = map_, camera

    def look(self, sight: Sight, go_on: Callable[[], bool] = lambda: True) -> list[ChangeEvent]:
        """Changes that are sure with this frame; nothing where the model gives none."""
        detections = faint = None
        if self.process is not None:
            found = self._segment(self.process, sight.frame, go_on)
            if found is None:
                return []
            is_sure = found.scores >= self._config.segmenter.min_score
            detections, faint = _rows(found, is_sure), _rows(found, ~is_sure)
            self._note_moving(sight.frame, detections)
        frame, surface = sight.frame, sight.surface()
        T_map_cam = np.eye(4) if sight.T_map_cam is None else sight.T_map_cam
        image = frame.index, frame.t_ns, frame.image
        look = Look(*image, T_map_cam, surface, detections, sight.depth, faint)
        if sight.T_map_cam is None:
            self._unplaced.append(look)
            return []
        stage = self._find_stage()
        events: list[ChangeEvent] = []
        for each in (*self._take_placed(sight, surface), look):
            if isinstance(stage, ChangeProcess):
                events += stage.step(each, go_on)
            elif stage is not None:
                events += stage.step(each)
        return events

    def _take_placed(self, sight: Sight, surface: F64) -> Iterator[Look]:
        """What was seen from where only this frame tells; no more of a map that has gone."""
        waiting, self._unplaced = self._unplaced, deque(maxlen=UNPLACED)
        for look in waiting:
            if look.index in sight.placed:
                yield replace(look, T_map_cam=sight.placed[look.index], surface=surface)
            else:
                self._unplaced.append(look)

    def take_moving(self) -> list[Moving]:
        """What moved in the last image, once; an image without such things is told, too."""
        moving, self._moving = self._moving, None
        return [] if moving is None else [moving]

    def tick(self) -> None:
        """Do what the process needs in time: its start, and its next one."""
        if self.process is not None:
            self.process.poll()

    def close(self) -> None:
        """End all processes."""
        if self.process is not None:
            self.process.close()
        self._end_stage()

    def _segment(
        self, process: SegmenterProcess, frame: Frame, go_on: Callable[[], bool]
    ) -> Detections | None:
        process.poll()
        if not process.offer(frame.index & 0xFFFFFFFF, colour_of(frame)):
            return None
        while process.status.state == "busy" and go_on():
            if (found := process.poll(_POLL_S)) is not None:
                return found.detections
        return None

    def _note_moving(self, frame: Frame, detections: Detections) -> None:
        assert self.process is not None
        assert self.process.contract is not None
        names, moving = self.process.contract.names, self._config.segmenter.moving
        labels = detections.classes.tolist()
        masks = [
            mask
            for label, mask in zip(labels, detections.masks, strict=True)
            if names[label] in moving
        ]
        if not set(moving).isdisjoint(names):
            self._moving = Moving(frame.index, frame.t_ns, tuple(masks))

    def _find_stage(self) -> "_Stage | None":
        contract = None if self.process is None else self.process.contract
        names = () if contract is None else contract.names
        if self._asked_for != (self._map, names):
            self._end_stage()
            self._asked_for = self._map, names
            self._stage = None if self._map is None else self._new_stage(self._map, names)
        return self._stage

    def _new_stage(self, map_: Map, names: tuple[str, ...]) -> "_Stage | None":
        labels = map_.manifest.labels
        if self.process is not None and (labels is None or tuple(labels.names) != names):
            log.warning(
                "event=%s map=%s: build it with --segmenter and this model for changes to be told",
                "no_labels" if labels is None else "labels_of_another_model",
                map_.folder,
            )
            if labels is None:
                return None
        config, threads = self._config, self._config.runtime.threads
        if self._apart:
            return ChangeProcess(
                Order(
                    map_folder=str(map_.folder.resolve()),
                    manifest=map_.manifest,
                    resident_bytes=config.map.resident_bytes,
                    camera=self._camera,
                    names=None if self.process is None else names,
                    config=config.changes,
                    nice=threads.changes_nice,
                    cpus=threads.changes_cpus,
                )
            )
        # Only here: they take memory that the daemon does not need.
        from edge.changes.changes import Changes
        from edge.changes.unlabelled import UnlabelledChanges

        if self.process is None:
            return UnlabelledChanges(map_, self._camera, config.changes)
        return Changes(map_, self._camera, names, config.changes)

    def _end_stage(self) -> None:
        if isinstance(self._stage, ChangeProcess):
            self._stage.close()
        self._stage = None


def _rows(found: Detections, kept: Bools) -> Detections:
    arrays = found.boxes[kept], found.scores[kept], found.classes[kept]
    return Detections(*arrays, tuple(found.masks[i] for i in np.flatnonzero(kept)))
