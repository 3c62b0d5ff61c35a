# SPDX-License-Identifier: Apache-2.0
"""Looks for changes beside the tracking: in its own thread live, at once but delayed in replay."""

import logging
from collections import deque
from collections.abc import Callable
from typing import Protocol

from edge.config import Config
from edge.errors import ModelRefused
from edge.geometry.camera import CameraModel
from edge.outputs.report import FrameReport
from edge.runtime.mailbox import Mailbox
from edge.runtime.sights import Chooser, Sight
from edge.runtime.watcher import Watcher
from edge.runtime.worker import Worker
from edge.tiles.reader import Map
from edge.types import ChangeEvent, Frame, Moving

log = logging.getLogger(__name__)

_KEPT_EVENTS = 64
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


class ReplayWatch:
    """Looks at once; what it finds takes effect a set number of frames later."""

    def __init__(self, config: Config, camera: CameraModel, map_: Map | None) -> None:
        self._chooser = Chooser(config, camera)
        self._watcher = Watcher(config, camera, map_, apart=False)
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
        self._watcher = Watcher(config, camera, map_, apart=True)
        # With the number of the map that they are of: a look may end after its map has gone.
        self._map_number = 0
        self._sights: Mailbox[tuple[int, Sight]] = Mailbox()
        self._events: Mailbox[tuple[int, ChangeEvent]] = Mailbox(_KEPT_EVENTS)
        self._moved: Mailbox[Moving] = Mailbox()
        self.paused = False
        self._worker = Worker("changes", self._run)

    @property
    def state(self) -> str:
        """How model and search fare, in words; empty without a model and where all is well."""
        process, trouble = self._watcher.process, self._watcher.trouble
        if process is None:
            return trouble
        status = process.status
        said = f"{status.state}: {status.reason}" if status.reason else status.state
        return f"{said}; {trouble}" if trouble else said

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
