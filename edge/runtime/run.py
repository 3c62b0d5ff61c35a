# SPDX-License-Identifier: Apache-2.0
"""Puts the daemon together from its settings; what these do not ask for is not even loaded."""

import logging
import sys
from collections.abc import Callable
from contextlib import ExitStack, closing
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import msgspec
import numpy as np
import zmq

from edge.cameras.recording import open_recording
from edge.config import Config
from edge.config.markers import MarkersConfig
from edge.config.threads import ThreadsConfig
from edge.errors import ConfigError, TileError, UnsupportedVersion
from edge.geometry.camera import CameraModel
from edge.outputs.curve import CurveServer
from edge.outputs.metrics import render
from edge.outputs.serial_output import make_stream
from edge.outputs.serial_stream import SerialStream
from edge.outputs.status import Facts
from edge.outputs.zmq_pub import ZmqPublisher
from edge.runtime.compile_watch import watch_compiles
from edge.runtime.daemon import Daemon
from edge.runtime.interrupt import stop_on_signal
from edge.runtime.live import OpenedMap, open_beside
from edge.runtime.live_player import LivePlayer, Source
from edge.runtime.memory import keep_small, settle_down
from edge.runtime.paced import PacedRecording
from edge.runtime.priority import settle
from edge.runtime.serial_sink import SerialSink
from edge.runtime.services import Answers, Services
from edge.runtime.swap_rehearsal import RehearsedSwitch, RehearsingStages
from edge.runtime.warm_up import warm_up
from edge.tiles.manifest import FILE_NAME as MANIFEST

if TYPE_CHECKING:
    from edge.runtime.recorder import Recorder
    from edge.runtime.watch import LiveWatch

log = logging.getLogger(__name__)


def run(config: Config) -> None:
    """Run until SIGTERM, Ctrl-C or the end of a recording that is played once.

    What a person has to mend before it can start is an EdgeError. Called in the main thread.
    """
    threads = config.runtime.threads
    _settle_process(threads)
    with ExitStack() as stack:
        source = _open_source(config)
        opener = partial(open_beside, config=config, camera=source.camera)
        opened, trouble = start_map(config, opener)
        if trouble:  # markers are placed in the map that is missing
            config = msgspec.structs.replace(config, markers=MarkersConfig())
        stream = start_stream(config, opened, trouble)
        context = stack.enter_context(zmq.Context())
        curve_config = config.outputs.zmq.curve
        curve = CurveServer(curve_config, context) if curve_config.secret_key else None
        publisher = stack.enter_context(closing(ZmqPublisher(config.outputs.zmq, context, curve)))
        starting = partial(
            Facts, map="" if opened is None else opened.name, camera="starting", notice=trouble
        )
        publisher.send_status(starting())
        warm_up(config, lambda: publisher.tick(starting))
        stages = stack.enter_context(closing(RehearsingStages(config, source.camera, opened)))
        late = stack.enter_context(watch_compiles())
        settle_camera = partial(settle, threads.camera_cpus, threads.camera_nice)
        player = stack.enter_context(closing(LivePlayer(source, settle_camera)))
        switch = RehearsedSwitch(opener, stages, config.tiles)
        daemon = Daemon(config, stages, player, publisher, switch)
        stack.enter_context(closing(daemon))
        with stop_on_signal(daemon.stop):
            daemon.serial = _open_serial(config, stream, stack)
            daemon.recorder = _open_recorder(config, source, stack)
            daemon.watch = _open_watch(config, source.camera, opened, stack)
            services = _services(config, context, curve, daemon, publisher)
            daemon.services = stack.enter_context(closing(services))
            services.start()
            if config.tiles.store:
                _attach_tiles(config, daemon, switch, source.camera, stack)
            if trouble:
                daemon.tell(trouble)
            settle(threads.tracking_cpus, threads.tracking_nice)
            settle_down()
            daemon.run()
        if late:
            log.warning("event=compiled_late kernels=%s", ",".join(late))


def _settle_process(threads: ThreadsConfig) -> None:
    cv2.setNumThreads(1)  # the cores belong to our own threads
    keep_small()
    sys.setswitchinterval(threads.switch_interval_us * 1e-6)


def _open_source(config: Config) -> Source:
    camera = config.camera
    if camera.source != "recording":
        from edge.cameras.live import open_live

        return open_live(camera, colour=bool(config.segmenter.model))
    if not camera.recording:
        raise ConfigError(
            "camera.recording: is empty: name a recording, or set camera.source to v4l2 or oak"
        )
    return PacedRecording(open_recording(camera.recording), camera.play)


def start_map(config: Config, opener: Callable[[Path], OpenedMap]) -> tuple[OpenedMap | None, str]:
    """The map of the settings, or else the current one of the store; and what is wrong with it.

    A damaged one is left out: started again it would be no better, and without it there is
    somebody to say so and to take another.
    """
    try:
        if config.map.folder:
            return opener(Path(config.map.folder)), ""
        if not config.tiles.store:
            return None, ""
        from edge.runtime.swap import open_store
        from edge.runtime.swap_boot import open_first

        return open_first(open_store(config.tiles), config.tiles.trial_starts, opener), ""
    except UnsupportedVersion:
        raise
    except TileError as error:
        if config.map.folder and not (Path(config.map.folder) / MANIFEST).exists():
            raise
        return None, f"going on without a map: {error}"


def start_stream(config: Config, opened: OpenedMap | None, trouble: str) -> SerialStream | None:
    """What goes over the serial line, if there is one; ConfigError where the map is not for it."""
    serial = config.outputs.serial
    if not serial.device or opened is not None:
        return None if opened is None else opened.serial_stream
    if trouble:  # no poses, but a word of it; the next map brings its own stream
        return make_stream(serial, metric=True, T_local_map=np.eye(4).tolist(), map_name="")
    if serial.protocol == "mavlink":
        raise ConfigError(
            "map.folder: is empty, and MAVLink takes poses in a map alone: name a map, install "
            "one into tiles.store (mapvo tiles install FILE), or set "
            "outputs.serial.protocol to binary or ascii"
        )
    return make_stream(serial, metric=False, T_local_map=None, map_name="map.folder")


def _open_serial(
    config: Config, stream: SerialStream | None, stack: ExitStack
) -> SerialSink | None:
    if stream is None:
        return None
    settle_it = partial(settle, (), config.runtime.threads.others_nice)
    return stack.enter_context(closing(SerialSink(config.outputs.serial, stream, settle_it)))


def _services(
    config: Config,
    context: "zmq.Context[zmq.Socket[bytes]]",
    curve: CurveServer | None,
    daemon: Daemon,
    publisher: ZmqPublisher,
) -> Services:
    answers = Answers(
        act=daemon.act,
        swap=daemon.swap,
        keep=daemon.keep,
        status=lambda: publisher.status,
        metrics=lambda: render(publisher.tally, publisher.status),
    )
    settle_others = partial(settle, (), config.runtime.threads.others_nice)
    return Services(config.outputs, context, curve, answers, settle_others)


def _attach_tiles(
    config: Config,
    daemon: Daemon,
    switch: RehearsedSwitch,
    camera: CameraModel,
    stack: ExitStack,
) -> None:
    from edge.runtime.swap import TileKeeper, open_store

    keeper = TileKeeper(config, open_store(config.tiles), daemon, switch.swap, camera)
    daemon.tiles = stack.enter_context(closing(keeper))


def _open_watch(
    config: Config, camera: CameraModel, opened: OpenedMap | None, stack: ExitStack
) -> "LiveWatch | None":
    if not (config.segmenter.model or config.changes.without_model):
        return None
    from edge.runtime.watch import LiveWatch

    settle_it = partial(settle, (), config.runtime.threads.others_nice)
    map_ = None if opened is None else opened.map
    lens = camera if opened is None else opened.camera
    return stack.enter_context(closing(LiveWatch(config, lens, map_, settle_it)))


def _open_recorder(config: Config, source: Source, stack: ExitStack) -> "Recorder | None":
    if not config.recorder.folder:
        return None
    from edge.runtime.recorder import Recorder
    from edge.runtime.versions import recording_header

    identity = str(getattr(source, "identity", ""))
    header = recording_header(source.camera, source.rate_hz, identity, config)
    return stack.enter_context(closing(Recorder(config.recorder, header)))
