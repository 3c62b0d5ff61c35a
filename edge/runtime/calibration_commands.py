# SPDX-License-Identifier: Apache-2.0
"""What `mapvo calibrate` and `mapvo board` do."""

import argparse
import math
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from edge.cameras import images as image_files
from edge.cameras import mcap
from edge.cameras.layout import ImageFile
from edge.cameras.recording import open_recording
from edge.capture.reader import CaptureFile, StoredImage
from edge.errors import ConfigError, OutputError, RecordingError
from edge.geometry.calibration import View
from edge.geometry.camera import load_camera_file
from edge.geometry.camera_text import camera_toml
from edge.runtime.board import Board, BoardSpec
from edge.runtime.calibrate import Calibration, calibrate_camera
from edge.runtime.calibration_picture import draw
from edge.store.durable import write_whole
from edge.types import U8

# ruff: noqa: T201  # printing is what this module is for

_MAX_IMAGES = 300  # of a recording; more show the same again
_SUFFIXES = (".png", ".jpg", ".jpeg", ".pgm", ".bmp", ".tif", ".tiff")


class _Source(NamedTuple):
    """Images of one camera."""

    files: list[ImageFile]
    identity: str = ""
    rate_hz: float | None = None


def calibrate(args: argparse.Namespace) -> int:
    """`mapvo calibrate`."""
    replaces = _holds_calibration(args.out)
    board = Board(_spec(args))
    source = _find_images(args.images)
    views, size = _find_views(board, source.files)
    found = calibrate_camera(views, len(source.files), *size, args.model)
    identity = args.identity if args.identity is not None else source.identity
    rate_hz = args.rate_hz if args.rate_hz is not None else source.rate_hz
    picture = args.picture or args.out.with_suffix(".png")
    title = _title(found, board.spec)
    text = f"# {title}\n{camera_toml(found.camera, rate_hz, identity)}"
    _write(args.out, text.encode())
    _write(picture, cv2.imencode(picture.suffix, draw(found, title))[1].tobytes())
    print(f"{args.out}: {title}" + ("; the earlier file there is gone" if replaces else ""))
    _say_sigmas(found)
    print(f"{picture}: where the corners lay, and how far off they are")
    if not identity:
        print("bound to no camera: name it with --identity, or calibrate from `mapvo record`")
    return 0


def draw_board(args: argparse.Namespace) -> int:
    """`mapvo board`."""
    spec = _spec(args)
    board = Board(spec)
    _write(args.out, cv2.imencode(args.out.suffix, board.draw())[1].tobytes())
    wide, high = spec.columns * spec.square_m, spec.rows * spec.square_m
    print(
        f"{args.out}: print it so that the squares together are {wide * 1e3:.1f} x "
        f"{high * 1e3:.1f} mm, measure that, and glue it on something flat"
    )
    return 0


def _holds_calibration(path: Path) -> bool:
    """Whether an earlier calibration lies at `path`; OutputError where something else does."""
    if not path.exists():
        return False
    try:
        load_camera_file(path)
    except ConfigError:
        raise OutputError(
            f"{path}: exists and is no calibration; name another place with --out"
        ) from None
    return True


def _spec(args: argparse.Namespace) -> BoardSpec:
    columns, rows = args.board
    marker_m = 0.75 * args.square if args.marker is None else args.marker
    return BoardSpec(columns, rows, args.square, marker_m, args.dictionary)


def _find_images(paths: list[Path]) -> _Source:
    """Images that the arguments name; RecordingError where they name none."""
    if len(paths) == 1:
        path = paths[0]
        if mcap.is_recording(path):
            return _of_capture(path)
        if path.is_dir():
            files = sorted(p for p in path.iterdir() if p.suffix.lower() in _SUFFIXES)
            if files:
                return _Source(list(files))
            recording = open_recording(path)
            chosen = recording.indices[:: 1 + len(recording) // _MAX_IMAGES]
            files_of = [recording.image_file(int(index)) for index in chosen]
            return _Source(files_of, "", recording.rate_hz)
    for path in paths:
        if not path.is_file():
            raise RecordingError(f"{path}: is no image; give images, their folder or a recording")
    return _Source(list(paths))


def _of_capture(path: Path) -> _Source:
    """Images of what `mapvo record` wrote, calibrated or not."""
    parts = [path] if path.is_file() else sorted(path.glob(f"*{mcap.SUFFIX}"))
    captures = [CaptureFile(part.resolve()) for part in parts]
    files: list[ImageFile] = []
    for capture in captures:
        files += [
            StoredImage(capture.path, place.chunk, place.offset, number)
            for number, place in enumerate(capture.image_places)
        ]
    if not files:
        raise RecordingError(f"{path}: holds no image")
    info = captures[0].header.info
    try:
        rate_hz: float | None = _rate(info.get("rate_hz", ""))
    except ValueError:
        rate_hz = None
    return _Source(files[:: 1 + len(files) // _MAX_IMAGES], info.get("identity", ""), rate_hz)


def _rate(text: str) -> float:
    """A frame rate; ValueError where the text is none."""
    value = float(text)
    if not 0.0 < value < math.inf:
        raise ValueError(text)
    return value


def _find_views(board: Board, files: list[ImageFile]) -> tuple[list[View], tuple[int, int]]:
    """What each image shows of the board, and the size (width, height) of all images."""
    views: list[View] = []
    size: tuple[int, int] | None = None
    for file, image in _read(files):
        found_size = (image.shape[1], image.shape[0])
        if size is not None and found_size != size:
            raise RecordingError(
                f"{file}: is {found_size[0]}x{found_size[1]}, the others are {size[0]}x{size[1]}: "
                "give images of one camera in one size"
            )
        size = found_size
        if (view := board.find(image)) is not None:
            views.append(view)
    assert size is not None
    return views, size


def _read(files: list[ImageFile]) -> Iterator[tuple[ImageFile, U8]]:
    for file in files:
        yield file, image_files.read_grey(file)


def _title(found: Calibration, spec: BoardSpec) -> str:
    return (
        f"calibrated from {len(found.views)} of {found.images} images of a {spec.columns}x"
        f"{spec.rows} board: rms {found.result.rms_px:.3f} px, held out {found.held_out_px:.3f} px"
    )


def _say_sigmas(found: Calibration) -> None:
    camera, sigma = found.camera, found.result.sigma
    for number, name in enumerate(("fx", "fy", "cx", "cy")):
        print(f"  {name} {getattr(camera, name):.3f} +- {sigma[number]:.3f}")
    terms = ", ".join(
        f"{value:.5f} +- {error:.5f}"
        for value, error in zip(camera.distortion, np.asarray(sigma)[4:], strict=True)
    )
    print(f"  {camera.distortion_model} {terms}")


def _write(path: Path, data: bytes) -> None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_whole(path, data)
    except OSError as error:
        raise OutputError(
            f"{path}: cannot be written: {error.strerror}; name another place"
        ) from error
