# SPDX-License-Identifier: Apache-2.0
"""Looks for changes beside the tracking: in its own thread live, at once but delayed in replay."""

import logging
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Protocol

from edge.changes.changes import Changes
from edge.changes.unlabelled import UnlabelledChanges
from edge.config import Config
from edge.errors import ModelRefused
from edge.geometry.camera import CameraModel
from edge.outputs.report import FrameReport
from edge.runtime.mailbox import Mailbox
from edge.runtime.sights import Chooser, Sight, colour_of
from edge.runtime.worker import Worker
from edge.segmenter.process import SegmenterProcess
from edge.tiles.labels import read_labels
from edge.tiles.reader import Map
from edge.types import ChangeEvent, Detections, Frame, Look, Moving

log = logging.getLogger(__name__)

_KEPT_EVENTS = 64
_POLL_S = 0.05
_WAIT_S = 0.2


class Watch(Protocol):
    """The search for changes as the tracking thread sees it; `step` does not wait when live."""

    def step(self, frame: Frame, report: FrameReport) -> list[ChangeEvent]:
        """Take a frame; the changes that take effect with it."""

    def moving(self) -> list[Moving]:
        """Where things move by themselves; of frames since the last call."""

    def finish(self) -> list[ChangeEvent]:
        """What was found and has not taken effect yet, after the last frame."""

    def close(self) -> None:
        """End all work."""


class Watcher:
    """The model's process and the stage that it serves. Owned by one thread."""

    def __init__(self, config: Config, camera: CameraModel, map_: Map | None) -> None:
        self._config, self._camera, self._map = config, camera, map_
        self.process: SegmenterProcess | None = None
        if config.segmenter.model:
            shape = (camera.height, camera.width, 3)
            self.process = SegmenterProcess(Path(config.segmenter.model), shape, config.segmenter)
        self._changes: Changes | UnlabelledChanges | None = None
        self._names: tuple[str, ...] | None = None
        self._moving: Moving | None = None

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
        self._map, self._camera, self._changes = map_, camera, None

    def look(self, sight: Sight, go_on: Callable[[], bool] = lambda: True) -> list[ChangeEvent]:
        """Changes that are sure with this frame; nothing where the model gives none."""
        detections = None
        if self.process is not None:
            detections = self._segment(self.process, sight.frame, go_on)
            if detections is None:
                return []
            self._note_moving(sight.frame, detections)
        frame = sight.frame
        if sight.T_map_cam is None:
            return []
        look = Look(
            *(frame.index, frame.t_ns, frame.image, sight.T_map_cam, sight.surface),
            *(detections, sight.depth),
        )
        stage = self._stage()
        return [] if stage is None else stage.step(look)

    def take_moving(self) -> list[Moving]:
        """What moved in the last image, once; an image without such things is told, too."""
        moving, self._moving = self._moving, None
        return [] if moving is None else [moving]

    def tick(self) -> None:
        """Do what the process needs in time: its start, and its next one."""
        if self.process is not None:
            self.process.poll()

    def close(self) -> None:
        """End the model's process."""
        if self.process is not None:
            self.process.close()

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

    def _stage(self) -> Changes | UnlabelledChanges | None:
        if self._map is None:
            return None
        contract = None if self.process is None else self.process.contract
        names = () if contract is None else contract.names
        if self._changes is None or names != self._names:
            self._names = names
            self._changes = self._new_stage(self._map, names)
        return self._changes

    def _new_stage(self, map_: Map, names: tuple[str, ...]) -> Changes | UnlabelledChanges:
        if self.process is None:
            return UnlabelledChanges(map_, self._camera, self._config.changes)
        labels = read_labels(map_)
        if labels is None or labels.names != names:
            log.warning(
                "event=%s map=%s: build it with --segmenter and this model for changes to be told",
                "no_labels" if labels is None else "labels_of_another_model",
                map_.folder,
            )
        return Changes(map_, self._camera, names, self._config.changes)


class ReplayWatch:
    """Looks at once; what it finds takes effect a set number of frames later."""

    def __init__(self, config: Config, camera: CameraModel, map_: Map | None) -> None:
        self._chooser = Chooser(config, camera)
        self._watcher = Watcher(config, camera, map_)
        self._delay = config.changes.delay_frames
        self._frame = 0
        self._due: deque[tuple[int, ChangeEvent]] = deque()
        self._moved: deque[tuple[int, Moving]] = deque()
        try:
            self._watcher.wait_until_ready()
        except ModelRefused:
            self.close()
            raise

    def step(self, frame: Frame, report: FrameReport) -> list[ChangeEvent]:
        """Take a frame; the changes that take effect with it."""
        self._frame += 1
        sight = self._chooser.choose(frame, report)
        if sight is not None:
            found = self._watcher.look(sight)
            due = self._frame + self._delay
            self._due.extend((due, event) for event in found)
            self._moved.extend((due, moving) for moving in self._watcher.take_moving())
        ready = []
        while self._due and self._due[0][0] <= self._frame:
            ready.append(self._due.popleft()[1])
        return ready

    def moving(self) -> list[Moving]:
        """Where things move by themselves, in frames whose masks have come by now."""
        ready = []
        while self._moved and self._moved[0][0] <= self._frame:
            ready.append(self._moved.popleft()[1])
        return ready

    def finish(self) -> list[ChangeEvent]:
        """What was found and has not taken effect yet."""
        events = [event for _, event in self._due]
        self._due.clear()
        return events

    def close(self) -> None:
        """End the model's process."""
        self._watcher.close()


class LiveWatch:
    """Looks in a thread of its own; the newest frame wins, and nobody waits for it."""

    def __init__(
        self,
        config: Config,
        camera: CameraModel,
        map_: Map | None,
        settle: Callable[[], None] | None = None,
    ) -> None:
        self._config = config
        self._chooser = Chooser(config, camera)
        self._settle = settle
        self._other: Mailbox[tuple[int, Map, CameraModel]] = Mailbox()
        self._watcher = Watcher(config, camera, map_)
        # With the number of the map that they are of: a look may end after its map has gone.
        self._map_number = 0
        self._sights: Mailbox[tuple[int, Sight]] = Mailbox()
        self._events: Mailbox[tuple[int, ChangeEvent]] = Mailbox(_KEPT_EVENTS)
        self._moved: Mailbox[Moving] = Mailbox()
        self.paused = False
        self._worker = Worker("changes", self._run)

    @property
    def state(self) -> str:
        """How the model fares, in words; empty without one."""
        process = self._watcher.process
        if process is None:
            return ""
        status = process.status
        return f"{status.state}: {status.reason}" if status.reason else status.state

    def use_map(self, map_: Map, camera: CameraModel) -> None:
        """Look in another map from now on; what was known of the old one is forgotten."""
        self._chooser = Chooser(self._config, camera)
        self._map_number += 1
        self._other.offer((self._map_number, map_, camera))

    def step(self, frame: Frame, report: FrameReport) -> list[ChangeEvent]:
        """Leave a frame for the thread; the changes since the last call."""
        self._worker.check()
        if not self.paused:
            sight = self._chooser.choose(frame, report)
            if sight is not None:
                self._sights.offer((self._map_number, sight))
        return self.finish()

    def moving(self) -> list[Moving]:
        """Where things move by themselves, as the thread has last seen."""
        return self._moved.drain()

    def finish(self) -> list[ChangeEvent]:
        """What the thread has found meanwhile in this map."""
        return [event for number, event in self._events.drain() if number == self._map_number]

    def close(self) -> None:
        """End the thread and the model's process; an image under way is given up."""
        self._sights.close()
        self._worker.join()
        self._watcher.close()

    def _run(self) -> None:
        if self._settle is not None:
            self._settle()
        number = 0
        while not self._sights.closed:
            taken = self._sights.take(_WAIT_S)
            for number, map_, camera in self._other.drain():  # noqa: B007  # the last one's stays
                self._watcher.use_map(map_, camera)
            if taken is None or taken[0] != number:
                self._watcher.tick()
                continue
            for event in self._watcher.look(taken[1], lambda: not self._sights.closed):
                log.info("event=change kind=%s label=%s", event.kind, event.label)
                self._events.offer((number, event))
            for moving in self._watcher.take_moving():
                self._moved.offer(moving)
