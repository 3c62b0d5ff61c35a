# SPDX-License-Identifier: Apache-2.0
"""`mapvo run`: a live camera to poses, all day, unattended."""

import logging
import time
from dataclasses import replace
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING

import msgspec

from edge.config import Config
from edge.errors import OutputError, TileError
from edge.outputs.control import Command, ResetCommand, StartPoseCommand
from edge.outputs.report import FrameReport, Sink
from edge.outputs.status import Facts
from edge.outputs.zmq_pub import ZmqPublisher
from edge.runtime.ladder import Ladder, Reading, Step, steps_of
from edge.runtime.live import LiveStages, OpenedMap
from edge.runtime.live_player import LivePlayer
from edge.runtime.mailbox import Mailbox
from edge.runtime.map_switch import Localised, MapSwitch
from edge.runtime.notify import Notifier
from edge.runtime.search import Search
from edge.runtime.serial_sink import SerialSink
from edge.runtime.services import Services
from edge.runtime.supply import Supply
from edge.runtime.thermometer import Thermometer
from edge.types import Frame, OdometryState

if TYPE_CHECKING:  # loaded where they are used only: together some 15 MB
    from edge.runtime.recorder import Recorder
    from edge.runtime.swap import TileKeeper
    from edge.runtime.watch import LiveWatch

log = logging.getLogger(__name__)

_TICK_S = 0.1  # without frames, everything else is looked after so often
_WAITING_COMMANDS = 4
_ADAPT_EVERY_NS = 1_000_000_000


class Daemon:
    """The loop of the tracking thread, which owns all in here.

    Other threads may call what `MapHost` names, and `act`.
    """

    def __init__(
        self,
        config: Config,
        stages: LiveStages,
        player: LivePlayer,
        publisher: ZmqPublisher,
        switch: MapSwitch,
    ) -> None:
        self._config = config
        self._stages = stages
        self._player = player
        self._publisher = publisher
        self._switch = switch
        self._notifier = Notifier()
        self._thermometer = Thermometer()
        self._supply = Supply()
        self._commands: Mailbox[Command] = Mailbox(_WAITING_COMMANDS)
        self._told = ""
        self._localised = Localised(0, 0)
        self._state: tuple[OdometryState | None, bool] = None, False
        self._ladder = Ladder(config.runtime.ladder, steps_of(config))
        self._adapted_ns = time.monotonic_ns()
        self._busy_ms: list[float] = []
        self._dropped_then = 0
        self._temperature_c = self._thermometer.celsius()
        self._sinks: list[Sink] = []
        self._stopped = False
        self._map_name = ""
        self.serial: SerialSink | None = None
        self.recorder: Recorder | None = None
        self.services: Services | None = None
        self.tiles: TileKeeper | None = None
        self.watch: LiveWatch | None = None
        self._name_map()

    # --- for other threads ---

    @property
    def map_folder(self) -> Path | None:
        """Folder of the map in use."""
        return None if self._stages.map is None else self._stages.map.folder

    def swap(self, map_folder: Path) -> None:
        """Use another map from the next frame on; EdgeError says why not."""
        self._switch.swap(map_folder)

    def localised(self) -> Localised:
        """Counts since the map in use was put in."""
        return self._localised

    def tell(self, text: str) -> None:
        """Say one line in the journal, the status topic and on the serial line."""
        log.warning("event=notice %s", text)
        self._told = text
        if self.serial is not None:
            self.serial.tell(text)

    def keep(self, reason: str) -> None:
        """Put the last recordings aside; OutputError where nothing is recorded."""
        if self.recorder is None:
            raise OutputError("recorder.folder: is empty: nothing is recorded that could be kept")
        self.recorder.keep(reason)

    def act(self, command: Command) -> bool:
        """Leave a command for the tracking; False where too many wait."""
        if len(self._commands) >= _WAITING_COMMANDS:
            return False
        self._commands.offer(command)
        return True

    def stop(self) -> None:
        """Let the loop end after the frame under way; a signal handler may call it."""
        self._stopped = True
        self._player.stop()

    # --- the loop ---

    def run(self) -> None:
        """Take frames until `stop` or the source's end; raises what nobody can mend from here."""
        try:
            self._run()
        finally:
            self._switch.close()

    def _run(self) -> None:
        self._sinks = [sink for sink in (self.serial, self.recorder) if sink is not None]
        self._notifier.ready()
        log.info("event=ready map=%s", self._map_name or "none")
        self._publisher.send_status(self._facts())
        while not self._stopped:
            frame = self._player.take(_TICK_S)
            now_ns = time.monotonic_ns()
            self._notifier.beat(now_ns)
            if self._switch.apply(self._use_map):
                log.info("event=map_in_use map=%s", self._map_name)
            for command in self._commands.drain():
                self._obey(command)
            if frame is not None:
                self._step(frame)
            elif self._player.ended:
                break
            else:
                self._publisher.tick(self._facts)
            if now_ns - self._adapted_ns >= _ADAPT_EVERY_NS:
                self._adapt(now_ns)
        self._notifier.stopping()
        log.info("event=stopping frames=%d", self._publisher.tally.frames)

    def close(self) -> None:
        """Free what this made itself."""
        self._notifier.close()

    def _step(self, frame: Frame) -> None:
        if self.recorder is not None:
            self.recorder.image(frame)
        report = self._track(frame)
        report = replace(
            report,
            timing=report.timing._replace(latency=(time.monotonic_ns() - frame.t_ns) * 1e-6),
            dropped_frames=self._player.dropped,
            captured_ns=frame.t_ns,
            map_name=self._map_name,
            changes=() if self.watch is None else tuple(self.watch.step(frame, report)),
        )
        for moving in () if self.watch is None else self.watch.moving():
            self._stages.hide(moving)
        self._publisher.write(report, self._facts)
        for sink in self._sinks:
            sink.write(report)
        self._busy_ms.append(report.timing.frame)
        self._count(report)

    def _track(self, frame: Frame) -> FrameReport:
        try:
            return self._stages.step(frame)
        except TileError as error:
            dropped = self.map_folder
            self._stages.drop_map()
            self._localised = Localised(0, 0)
            self._name_map()
            self.tell(f"going on without a map: {error}")
            if self.tiles is not None and dropped is not None:
                self.tiles.return_from_damage(dropped)
            return self._stages.step(frame)

    def _count(self, report: FrameReport) -> None:
        published = report.pose is not None
        tracked, counted = self._localised
        tracking = report.update.state is OdometryState.TRACKING
        self._localised = Localised(tracked + tracking, counted + published)
        state = (report.update.state, published)
        if state != self._state:
            self._state = state
            log.info("event=state odometry=%s localised=%d", state[0].value, published)

    def _use_map(self, opened: OpenedMap) -> Search:
        old = self._stages.use_map(opened)
        if self.serial is not None and opened.serial_stream is not None:
            self.serial.use(opened.serial_stream)
        if self.watch is not None:
            self.watch.use_map(opened.map, opened.camera)
        self._localised = Localised(0, 0)
        self._told = ""  # it was of the map before; who has asked for this one may tell more
        self._name_map()
        return old

    def _name_map(self) -> None:
        folder = self.map_folder
        self._map_name = "" if folder is None else folder.resolve().name

    def _obey(self, command: Command) -> None:
        if isinstance(command, ResetCommand):
            self._stages.reset()
        elif isinstance(command, StartPoseCommand):
            self._stages.set_start(*command.pose())

    def _adapt(self, now_ns: int) -> None:
        """Look how it goes; give something up, or take it up again. Once a second."""
        interval_ms = 1e3 / self._player.rate_hz
        if Step.HALF_RATE in self._ladder.given_up:
            interval_ms *= 2.0
        dropped = self._player.dropped - self._dropped_then
        frames = max(len(self._busy_ms) + dropped, 1)
        busy = median(self._busy_ms) / interval_ms if self._busy_ms else 0.0
        self._temperature_c = self._thermometer.celsius()
        supply = self._supply.read()
        under_voltage = supply is not None and supply.low
        reading = Reading(self._temperature_c, busy, dropped / frames, under_voltage)
        # Without frames nobody knows whether there is room for more.
        if self._busy_ms and self._ladder.step(now_ns, reading):
            self._give_up(self._ladder.given_up)
        self._dropped_then += dropped
        self._busy_ms.clear()
        self._adapted_ns = now_ns
        self._tell_systemd()
        for beside in (self.services, self.tiles):
            if beside is not None:
                beside.check()

    def _give_up(self, steps: tuple[Step, ...]) -> None:
        log.warning(
            "event=ladder level=%d given_up=%r reasons=%r",
            len(steps),
            "; ".join(step.value for step in steps),
            "; ".join(self._ladder.reasons),
        )
        odometry = self._config.odometry
        if Step.LEAN in steps:
            odometry = msgspec.structs.replace(odometry, preset="lean")
        stretch = self._config.runtime.ladder.query_stretch
        self._stages.stretch_queries(stretch if Step.RELOCALISE_LESS in steps else 1)
        self._stages.use_preset(odometry)
        if self.watch is not None:
            self.watch.paused = Step.CHANGES in steps
        self._player.keep_every = 2 if Step.HALF_RATE in steps else 1

    def _facts(self) -> Facts:
        given_up = self._ladder.given_up
        return Facts(
            map=self._map_name,
            camera=self._player.state(time.monotonic_ns()),
            camera_losses=self._player.losses,
            level=len(given_up),
            given_up=tuple(step.value for step in given_up),
            reasons=self._ladder.reasons,
            temperature_c=self._temperature_c,
            refused_clients=0 if self.services is None else self.services.refused_clients,
            recorder="" if self.recorder is None else self.recorder.state,
            notice=self._told,
            segmenter="" if self.watch is None else self.watch.state,
        )

    def _tell_systemd(self) -> None:
        status = self._publisher.status
        if status is not None:
            place = f"in {status.map}" if status.localised else "not localised"
            self._notifier.status(
                f"camera {status.camera}, {status.state}, {place}, {status.rate_hz:.0f} Hz, "
                f"latency {status.latency_ms:.0f} ms, level {status.level}"
            )
