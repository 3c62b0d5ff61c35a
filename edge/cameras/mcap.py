# SPDX-License-Identifier: Apache-2.0
"""Recording files (MCAP) as recordings: one file, or the folder of a session's files."""

import logging
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from edge.cameras.layout import Layout
from edge.cameras.tables import median_rate_hz
from edge.capture.format import Header
from edge.capture.reader import CaptureFile, Place, StoredImage
from edge.errors import RecordingError

log = logging.getLogger(__name__)

SUFFIX = ".mcap"


def is_recording(root: Path) -> bool:
    """Tell whether `root` is such a file, or a folder of them."""
    return root.suffix == SUFFIX if root.is_file() else any(root.glob(f"*{SUFFIX}"))


def read(root: Path) -> Layout:
    """Layout of a recording; RecordingError says what is wrong with it."""
    files = [root] if root.is_file() else sorted(root.glob(f"*{SUFFIX}"))
    captures = _one_session([CaptureFile(path.resolve()) for path in files])
    images = _increasing(root, captures)
    if not images:
        raise RecordingError(f"{root}: holds no image")
    t_ns = np.array([place.t_ns for _, place in images], np.int64)
    try:
        camera_file = captures[0].header.camera_file()
    except RecordingError as error:
        raise RecordingError(f"{captures[0].path}: {error}") from None
    rate_hz = camera_file.rate_hz or median_rate_hz(t_ns)
    if rate_hz is None:
        raise RecordingError(f"{root}: one image does not tell a frame rate; record more")
    return Layout(
        root=root,
        camera=camera_file.camera,
        rate_hz=rate_hz,
        t_ns=t_ns,
        images=tuple(
            StoredImage(path, place.chunk, place.offset, number)
            for number, (path, place) in enumerate(images)
        ),
        groundtruth=lambda: None,
    )


def _one_session(captures: Sequence[CaptureFile]) -> list[CaptureFile]:
    """The files in their order; RecordingError where they are of several recordings."""

    def key(header: Header) -> tuple[str, str]:
        return header.session, header.camera_toml

    first = captures[0]
    for other in captures[1:]:
        if key(other.header) != key(first.header):
            raise RecordingError(
                f"{first.path.parent}: holds several recordings: name one file, "
                f"{first.path.name} or {other.path.name}"
            )
    return sorted(captures, key=lambda capture: capture.header.segment)


def _increasing(root: Path, captures: Sequence[CaptureFile]) -> list[tuple[Path, Place]]:
    """All images whose times increase; others come where a clock was set back, and are left out."""
    chosen: list[tuple[Path, Place]] = []
    left_out = 0
    for capture in captures:
        for place in capture.image_places:
            if chosen and place.t_ns <= chosen[-1][1].t_ns:
                left_out += 1
            else:
                chosen.append((capture.path, place))
    if left_out:
        log.warning("event=images_out_of_order recording=%s left_out=%d", root, left_out)
    return chosen
