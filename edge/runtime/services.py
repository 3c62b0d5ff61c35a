# SPDX-License-Identifier: Apache-2.0
"""Everything that others ask of the daemon, in one thread beside the tracking."""

import logging
from collections import deque
from collections.abc import Callable
from contextlib import ExitStack, closing
from dataclasses import dataclass
from pathlib import Path

import zmq

from edge.config.outputs import OutputsConfig
from edge.errors import EdgeError
from edge.outputs import wire
from edge.outputs.control import (
    Asked,
    Command,
    ControlSocket,
    KeepCommand,
    Reply,
    StatusCommand,
    SwapCommand,
)
from edge.outputs.curve import CurveServer
from edge.outputs.metrics import MetricsServer
from edge.runtime.worker import Worker

log = logging.getLogger(__name__)

_TICK_MS = 200


@dataclass(frozen=True, slots=True)
class Answers:
    """What the daemon does and says when it is asked; all may be called from another thread."""

    act: Callable[[Command], bool]  # hands a command to the tracking, or says that it is busy
    swap: Callable[[Path], None]  # may take long, so it has a thread of its own while it lasts
    keep: Callable[[str], None]
    status: Callable[[], wire.StatusMessage | None]
    metrics: Callable[[], str]


class Services:
    """Control socket, admission of clients, and metrics.

    Made by the tracking thread; from `start` on, its own thread owns what is in here.
    """

    def __init__(
        self,
        config: OutputsConfig,
        context: "zmq.Context[zmq.Socket[bytes]]",
        curve: CurveServer | None,
        answers: Answers,
        settle: Callable[[], None] | None = None,
    ) -> None:
        self._settle = settle
        self._answers = answers
        self._curve = curve
        self._stack = ExitStack()
        self._poller = zmq.Poller()
        self._stopped = False
        self._swapping: Worker | None = None
        self._swapped: deque[tuple[Asked, str]] = deque()
        self._thread: Worker | None = None
        self.control: ControlSocket | None = None
        self.metrics: MetricsServer | None = None
        try:
            if config.zmq.control:
                self.control = ControlSocket(config.zmq.control, context, curve)
                self._stack.enter_context(closing(self.control))
                self._poller.register(self.control.socket, zmq.POLLIN)
            if config.metrics.port:
                self.metrics = MetricsServer(config.metrics, answers.metrics)
                self._stack.enter_context(closing(self.metrics))
                self._poller.register(self.metrics.listener, zmq.POLLIN)
        except EdgeError:
            self._stack.close()
            raise
        if curve is not None:
            self._stack.enter_context(closing(curve))
            for socket in curve.sockets:
                self._poller.register(socket, zmq.POLLIN)

    @property
    def refused_clients(self) -> int:
        """Clients that were not let in."""
        return 0 if self._curve is None else self._curve.refused

    def start(self) -> None:
        """Begin to answer."""
        self._thread = Worker("services", self._run)

    def check(self) -> None:
        """Raise here what ended the thread, if anything did."""
        if self._thread is not None:
            self._thread.check()

    def close(self) -> None:
        """End the thread and free all sockets."""
        self._stopped = True
        if self._thread is None:
            self._stack.close()
        else:
            self._thread.join()

    def _run(self) -> None:
        if self._settle is not None:
            self._settle()
        with self._stack:
            try:
                while not self._stopped:
                    self._serve()
            except zmq.ZMQError:
                if not self._stopped:
                    raise
                return  # its sockets are gone: the end was not waited for
            if self._swapping is not None:
                self._swapping.join()

    def _serve(self) -> None:
        ready = dict(self._poller.poll(_TICK_MS))
        self._admit()
        self._serve_metrics(ready)
        self._obey()

    def _admit(self) -> None:
        if self._curve is not None:
            self._curve.answer()

    def _serve_metrics(self, ready: "dict[object, int]") -> None:
        if self.metrics is None:
            return
        for descriptor in self.metrics.connections:
            if descriptor in ready:
                self._poller.unregister(descriptor)
                self.metrics.answer(descriptor)
        if self.metrics.listener.fileno() in ready:
            before = set(self.metrics.connections)
            self.metrics.accept()
            after = set(self.metrics.connections)
            for descriptor in before - after:
                self._poller.unregister(descriptor)
            for descriptor in after - before:
                self._poller.register(descriptor, zmq.POLLIN)

    def _obey(self) -> None:
        if self.control is None:
            return
        while self._swapped:
            asked, error = self._swapped.popleft()
            self._reply(asked, error)
        for asked in self.control.take():
            if isinstance(asked.command, StatusCommand):
                status = self._answers.status()
                self._reply(asked, "" if status else "no status yet: just started", status)
            elif isinstance(asked.command, SwapCommand):
                self._begin_swap(asked, Path(asked.command.map))
            elif isinstance(asked.command, KeepCommand):
                self._keep(asked, asked.command.reason)
            else:
                log.info("event=command name=%s", type(asked.command).__name__)
                taken = self._answers.act(asked.command)
                self._reply(asked, "" if taken else "busy: try again")

    def _keep(self, asked: Asked, reason: str) -> None:
        try:
            self._answers.keep(reason)
        except EdgeError as refused:
            self._reply(asked, str(refused))
        else:
            self._reply(asked, "")

    def _begin_swap(self, asked: Asked, folder: Path) -> None:
        if self._swapping is not None and self._swapping.is_alive:
            self._reply(asked, "another swap is under way: wait for its end")
            return

        def work() -> None:
            error = "failed: see the log"
            try:
                self._answers.swap(folder)
                error = ""
            except EdgeError as refused:
                error = str(refused)
            finally:
                self._swapped.append((asked, error))

        log.info("event=command name=swap map=%s", folder)
        self._swapping = Worker("swap", work)

    def _reply(self, asked: Asked, error: str, status: wire.StatusMessage | None = None) -> None:
        assert self.control is not None
        reply = Reply(not error, wire.SCHEMA_VERSION, asked.command.id, error, status)
        self.control.reply(asked.envelope, reply)
