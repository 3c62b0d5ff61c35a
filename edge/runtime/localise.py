# SPDX-License-Identifier: Apache-2.0
"""Finds single images in a map, without odometry."""

import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2
import msgspec

from edge.cameras import images
from edge.config import Config
from edge.geometry.camera import CameraModel, load_camera
from edge.outputs.report import FixReport
from edge.outputs.rows import FixRow, fix_row
from edge.runtime.learned import make_relocaliser
from edge.runtime.search import timed_step
from edge.tiles.reader import open_map
from edge.types import U8, Frame, Query


class ImageFix(FixRow, frozen=True):
    """One line of what `mapvo localise` gives: that of fixes.jsonl, and the image."""

    image: str


def localise_images(
    map_folder: Path, files: Sequence[Path], camera_file: Path, config: Config
) -> Iterator[ImageFix]:
    """The relocaliser's answer for each image alone; `t_ns` is 0, as single images have no time."""
    cv2.setNumThreads(1)
    camera = load_camera(camera_file)
    map_ = open_map(map_folder, resident_bytes=config.map.resident_bytes)
    resident = config.map.resident_bytes
    relocaliser = make_relocaliser(map_, camera, config.relocalise, resident)
    for index, file in enumerate(files):
        query = Query(Frame(index, 0, _read(file, camera)))
        fix = timed_step(relocaliser, query, time.thread_time_ns)
        row = fix_row(FixReport(fix, fix.found, fix.reason))
        yield ImageFix(**msgspec.structs.asdict(row), image=_text(file))


def _text(file: Path) -> str:
    """A name as text, whatever its bytes are."""
    return str(file).encode(errors="backslashreplace").decode()


def _read(file: Path, camera: CameraModel) -> U8:
    image = images.read_grey(file)
    images.check_size(file, image, camera.width, camera.height)
    return image
