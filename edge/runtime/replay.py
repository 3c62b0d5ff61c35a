# SPDX-License-Identifier: Apache-2.0
"""Runs the whole pipeline on a recording and writes a run folder."""

import logging
import sys
import time
from collections.abc import Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2

from edge.cameras.recording import open_recording
from edge.config import Config
from edge.geometry.camera import CameraModel
from edge.outputs.report import Sink
from edge.outputs.run_folder import RunFolder
from edge.outputs.zmq_pub import ZmqPublisher
from edge.runtime.compile_watch import watch_compiles
from edge.runtime.interrupt import stop_on_signal
from edge.runtime.memory import keep_small, settle_down
from edge.runtime.pipeline import Pipeline
from edge.runtime.player import Arrival, OfflinePlayer, Player, RealTimePlayer
from edge.runtime.progress import progress
from edge.runtime.stages import live_pipeline, replay_pipeline
from edge.runtime.tally import Tally
from edge.runtime.warm_up import warm_up
from edge.tiles.reader import Map, open_map

if TYPE_CHECKING:
    from edge.runtime.change_pictures import ChangePictures
    from edge.runtime.watch import Watch

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class ReplayJob:
    """What to run on what."""

    recording: Path
    out: Path
    map_folder: Path | None = None
    frames: slice | None = None
    stride: int = 1
    reverse: bool = False
    realtime: bool = False


def replay(job: ReplayJob, config: Config) -> tuple[dict[str, Any], Path]:
    """Write the run folder `job.out` whole or not at all; return its stats and where it lies.

    Ctrl-C ends the play, not the run: what was played is written, beside an earlier run that went
    to its end.
    """
    keep_small()
    cv2.setNumThreads(1)  # the cores belong to our own threads, and sums keep their order
    camera = open_recording(
        job.recording, frames=job.frames, stride=job.stride, reverse=job.reverse
    )
    map_ = None
    if job.map_folder is not None:
        map_ = open_map(job.map_folder, resident_bytes=config.map.resident_bytes)
    with ExitStack() as stack:
        folder = stack.enter_context(RunFolder(job.out, camera.camera))
        sinks: list[Sink] = [folder]
        if job.realtime or config.outputs.zmq.in_replay:
            sinks.append(stack.enter_context(closing(ZmqPublisher(config.outputs.zmq))))
        warm_up(config)
        if job.realtime:
            sys.setswitchinterval(config.runtime.threads.switch_interval_us * 1e-6)
        make_pipeline = live_pipeline if job.realtime else replay_pipeline
        pipeline = stack.enter_context(make_pipeline(config, camera.camera, map_))
        player = RealTimePlayer(camera) if job.realtime else OfflinePlayer(camera)
        stack.enter_context(closing(player))
        watch = _open_watch(job, config, camera.camera, map_)
        if watch is not None:
            stack.enter_context(closing(watch))
        pictures = _open_pictures(folder, watch, map_, camera.camera)
        sinks += [pictures] if pictures is not None else []

        settle_down()
        late = stack.enter_context(watch_compiles())
        tally = Tally()
        with stop_on_signal(player.stop) as interruption:
            run(player, pipeline, sinks, tally, watch, _name(job.map_folder), len(camera))
        tally.end()
        stats = tally.stats(0 if job.map_folder is None else folder_bytes(job.map_folder))
        stats["interrupted"] = interruption.came
        if late:
            log.warning("event=compiled_late kernels=%s", ",".join(late))
        if watch is not None and pictures is not None:
            for event in watch.finish():
                folder.write_change(event)
                pictures.add(event)
            pictures.finish()
        place = folder.finish(pipeline.trajectory(), stats)
    return stats, place


def _name(map_folder: Path | None) -> str:
    name = "" if map_folder is None else map_folder.resolve().name
    return name.encode(errors="backslashreplace").decode()


def _open_watch(
    job: ReplayJob, config: Config, camera: CameraModel, map_: Map | None
) -> "Watch | None":
    """What looks for changes and moving things: with a model, or in a map if asked for without."""
    if not (config.segmenter.model or (map_ is not None and config.changes.without_model)):
        return None
    from edge.runtime.watch import LiveWatch, ReplayWatch

    make = LiveWatch if job.realtime else ReplayWatch
    return make(config, camera if map_ is None else map_.camera_for(camera), map_)


def _open_pictures(
    folder: RunFolder, watch: "Watch | None", map_: Map | None, camera: CameraModel
) -> "ChangePictures | None":
    if watch is None or map_ is None:
        return None
    from edge.runtime.change_pictures import ChangePictures

    return ChangePictures(folder, map_, map_.camera_for(camera))


def run(
    player: Player,
    pipeline: Pipeline,
    sinks: Sequence[Sink],
    tally: Tally,
    watch: "Watch | None" = None,
    map_name: str = "",
    total: int = 0,
) -> None:
    """Take every frame through the pipeline to all sinks; `total` of them, where that is known."""
    for arrival in progress(player, total, "frames") if total else player:
        report = pipeline.step(arrival.frame)
        if watch is not None:
            report = replace(report, changes=tuple(watch.step(arrival.frame, report)))
            for moving in watch.moving():
                pipeline.hide(moving)
        report = replace(
            report,
            timing=report.timing._replace(latency=latency_ms(arrival, report.timing.frame)),
            dropped_frames=player.dropped,
            captured_ns=arrival.captured_ns,
            map_name=map_name,
        )
        for sink in sinks:
            sink.write(report)
        tally.add(report, arrival.decode_ms)


def latency_ms(arrival: Arrival, frame_ms: float) -> float:
    """From capture until now; without real time, what decoding and the stages took."""
    if arrival.captured_ns is None:
        return arrival.decode_ms + frame_ms
    return (time.monotonic_ns() - arrival.captured_ns) * 1e-6


def folder_bytes(folder: Path) -> int:
    """Size of all files of a map."""
    return sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())
