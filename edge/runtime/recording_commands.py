# SPDX-License-Identifier: Apache-2.0
"""What `mapvo record` and `mapvo recover` do."""

import argparse
from pathlib import Path

from edge.cameras.live import open_live, open_uncalibrated
from edge.cameras.recording import open_recording
from edge.capture.seal import seal
from edge.config import load_config
from edge.errors import EdgeError, OutputError, RecordingError
from edge.geometry.camera import CameraModel
from edge.runtime.record import Fetched, Limits, Played
from edge.runtime.record import record as run_record
from edge.runtime.versions import recording_header

# ruff: noqa: T201  # printing is what this module is for


def record(args: argparse.Namespace) -> int:
    """`mapvo record`."""
    config = load_config(args.config)
    identity = ""
    source: Played | Fetched
    model: CameraModel | None
    if args.recording is not None or config.camera.source == "recording":
        path = args.recording or Path(config.camera.recording)
        if path == Path():
            raise RecordingError("nothing to record: name a SEQUENCE, or a camera in the settings")
        camera = open_recording(path, frames=args.frames, stride=args.stride)
        source = Played(camera)
        model, rate_hz = camera.camera, camera.rate_hz
    else:
        is_calibrated = bool(config.camera.calibration) or config.camera.source == "oak"
        to_calibrate = args.uncalibrated or not is_calibrated
        live = (open_uncalibrated if to_calibrate else open_live)(config.camera)
        source = Fetched(live)
        model = None if to_calibrate else live.camera
        rate_hz, identity = live.rate_hz, live.identity
    limits = Limits(args.count, args.seconds, config.recorder.min_free_mb)
    header = recording_header(model, rate_hz, identity, config)
    done = run_record(source, args.out, header, args.images, limits)
    if done.full and not done.frames:
        args.out.unlink()
        raise OutputError(
            f"{args.out}: its disk has less than {limits.min_free_mb:g} MB left "
            "(recorder.min_free_mb); make room, or name another place with --out"
        )
    print(
        f"{args.out}: {done.frames} frames, {done.dropped} dropped, {done.size_bytes / 1e6:.1f} MB"
        + ("; ended because the disk has too little room left" if done.full else "")
    )
    return 0


def recover(args: argparse.Namespace) -> int:
    """`mapvo recover`: each file for itself; the first that cannot be mended is the error."""
    failed: EdgeError | None = None
    for path in args.files:
        try:
            sealed = seal(path)
        except EdgeError as error:
            failed = failed or error
            continue
        if sealed.was_whole:
            print(f"{path}: whole already, {sealed.messages} messages")
        else:
            print(f"{path}: mended, {sealed.messages} messages, {sealed.cut_bytes} bytes cut off")
        if sealed.bad_chunks:
            print(f"{path}: {sealed.bad_chunks} damaged chunks are left out")
    if failed is not None:
        raise failed
    return 0
