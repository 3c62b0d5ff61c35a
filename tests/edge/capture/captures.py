# SPDX-License-Identifier: Apache-2.0
"""Small recording files, written by the real writer."""

from pathlib import Path
from typing import Literal

import numpy as np

from edge.capture import format as format_
from edge.capture.format import Header
from edge.capture.writer import CaptureWriter
from edge.geometry.camera import CameraModel
from edge.geometry.camera_text import camera_toml

CAMERA = CameraModel(64, 48, 60.0, 61.0, 31.5, 23.5, "radtan", (-0.1, 0.01, 0.0, 0.001))
PERIOD_NS = 100_000_000
SCHEMAS = {format_.STATE: ("State", b'{"type": "object"}')}


def header(session: str = "one", segment: int = 0) -> Header:
    return Header(camera_toml(CAMERA, 10.0, "serial:A1"), session, segment, {"mapvo": "0"})


def picture(number: int) -> np.ndarray:
    return np.random.default_rng(number).integers(0, 256, (48, 64), dtype=np.uint8)


def write(
    path: Path,
    count: int = 25,
    *,
    first: int = 0,
    images: Literal["png", "raw"] = "png",
    made: Header | None = None,
    finish: bool = True,
) -> Path:
    """`count` frames and as many rows; without `finish` it ends as a killed process leaves it."""
    with CaptureWriter(path, made or header(), SCHEMAS, images) as writer:
        for number in range(first, first + count):
            writer.add_image(number * PERIOD_NS, number, picture(number))
            writer.add_row(format_.STATE, number * PERIOD_NS, b'{"n": %d}' % number)
        if finish:
            writer.finish()
    return path
