# SPDX-License-Identifier: Apache-2.0
"""Runs the process of COLMAP on a job, and reads what it found."""

import os
import re
import signal
import subprocess
import sys
import tempfile
from collections import deque
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edge.cameras import colmap_files
from edge.errors import OutputError, RecordingError
from edge.geometry import se3
from edge.runtime.progress import progress
from edge.types import F32, F64
from maps.sfm import job as job_file
from maps.sfm.job import Job, from_colmap

I64 = NDArray[np.int64]

COMMAND = ("-m", "maps.sfm.child")
# What the process itself says; libraries in it may say other things.
_WORDS = re.compile(r"(?:error .*|(?:features|matches|poses) \d+ \d+)\n")

# Sightings kept of each image: enough to compare distances with given depth.
_SIGHTINGS = 500
# A part this large of all images, or three, is a place of its own and not a few odd images.
_PART = 0.05
_LEAST_PLACED = 0.5


class SfmResult(NamedTuple):
    """Poses in a frame and a unit of their own; of the images that could be placed."""

    photo: I64  # (n,) in Job.photos, ascending
    T_world_cam: F64  # (n, 4, 4)
    k1: F64  # (cameras,) found; 0 where the calibration has a lens of its own
    offsets: I64  # (n + 1,) of the sightings
    pixels: F32  # (m, 2) raw
    depth: F32  # (m,) along z, in the unit of the poses


def solve(job: Job) -> SfmResult:
    """Poses of the job's images; RecordingError where they do not hang together."""
    try:
        with tempfile.TemporaryDirectory(prefix="mapvo-sfm-") as name:
            folder = Path(name)
            job_file.write(job, folder)
            _run(folder)
            return _result(job, folder / job_file.MODELS)
    except OSError as error:
        where = tempfile.gettempdir()
        raise OutputError(f"{where}: cannot be written ({error.strerror}); make room") from None


def _run(folder: Path) -> None:
    """Let the process do its work; RecordingError says how it ended if it did so badly."""
    last: deque[str] = deque([""], 1)  # of what is not its own words: the reason, if it ends badly
    with subprocess.Popen(
        [sys.executable, *COMMAND, str(folder)],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        errors="replace",
        env={**os.environ, "TMPDIR": str(folder)},  # its libraries leave files there
    ) as process:
        try:
            assert process.stdout is not None
            said = _follow(_own_words(process.stdout, last))
            status = process.wait()
        finally:
            process.kill()
    if said is not None:
        raise RecordingError(said)
    if status != 0:
        how = signal.Signals(-status).name if status < 0 else f"status {status}"
        reason = f": {last[0]}" if last[0] else ""
        raise RecordingError(
            f"COLMAP ended in the middle of its work ({how}{reason}); "
            "look for room on the disk and in memory, or take fewer images"
        )


def _own_words(lines: Iterable[str], last: deque[str]) -> Iterator[str]:
    """The lines that the process itself writes; the last one of others is left in `last`."""
    for line in lines:
        if _WORDS.fullmatch(line):
            yield line
        elif line.strip():
            last.append(line.strip())


def _follow(lines: Iterator[str]) -> str | None:
    """Show how far the process is, by its own words; its last words, if it says what is wrong."""
    pending: list[str] = []
    while (line := pending.pop() if pending else next(lines, None)) is not None:
        if line.startswith("error "):
            return line.removeprefix("error ").strip()
        stage, _, total = line.split()
        for _ in progress(_of_stage(stage, line, lines, pending), int(total), stage):
            pass
    return None


def _of_stage(stage: str, first: str, lines: Iterator[str], pending: list[str]) -> Iterator[None]:
    """One item for each thing done; the line that tells of another stage is left in `pending`."""
    done = 0
    line: str | None = first
    while line is not None and line.startswith(stage + " "):
        target = int(line.split()[1])
        for _ in range(target - done):
            yield
        done = target
        line = next(lines, None)
    if line is not None:
        pending.append(line)


def _result(job: Job, models: Path) -> SfmResult:
    found = [
        (colmap_files.read_images(folder), folder)
        for folder in sorted(models.iterdir(), key=lambda folder: int(folder.name))
    ]
    if not found:
        raise RecordingError(
            f"{_root(job)}: no two of the {len(job.photos)} images could be placed against each "
            "other; take more images, overlapping by half, moved sideways"
        )
    found.sort(key=lambda entry: -len(entry[0]))
    _check_connected(job, [[image.number - 1 for image in images] for images, _ in found])
    images, folder = found[0]
    cameras = colmap_files.read_cameras(folder)
    points = colmap_files.read_points(folder)
    pixels, depths = [], []
    for image in images:
        chosen = np.linspace(0, len(image.point) - 1, min(len(image.point), _SIGHTINGS)).astype(int)
        row = np.searchsorted(points.number, image.point[chosen])
        local = se3.transform(se3.inverse(image.T_world_cam), points.xyz[row])
        camera = job.cameras[job.photos[image.number - 1].camera]
        pixels.append(from_colmap(camera, image.pixels[chosen]).astype(np.float32))
        depths.append(local[:, 2].astype(np.float32))
    k1 = [
        cameras[i + 1].distortion[:1] if i + 1 in cameras else () for i in range(len(job.cameras))
    ]
    return SfmResult(
        photo=np.array([image.number - 1 for image in images], np.int64),
        T_world_cam=np.array([image.T_world_cam for image in images]),
        k1=np.array([k[0] if k else 0.0 for k in k1]),
        offsets=np.concatenate([[0], np.cumsum([len(depth) for depth in depths])]),
        pixels=np.concatenate(pixels),
        depth=np.concatenate(depths),
    )


def _check_connected(job: Job, parts: list[list[int]]) -> None:
    """Refuse images that fall into places without a connection, or can hardly be placed."""
    total, taken = len(job.photos), set(parts[0])
    others = []
    for part in parts[1:]:
        if own := sorted(set(part) - taken):
            others.append(own)
            taken.update(own)
    large = [part for part in others if len(part) >= max(3, _PART * total)]
    if large:
        groups = "; ".join(_named(job, part) for part in [sorted(parts[0]), *large])
        raise RecordingError(
            f"the images fall into {len(large) + 1} groups that nothing connects ({groups}); "
            "add images between them, or build them apart"
        )
    if len(parts[0]) < _LEAST_PLACED * total:
        raise RecordingError(
            f"{_root(job)}: only {len(parts[0])} of the {total} images could be placed; take "
            "images that overlap by half, sharp and moved sideways"
        )


def _named(job: Job, part: list[int]) -> str:
    """Some images of a group, by their recording and index."""
    first, last = job.photos[part[0]], job.photos[part[-1]]
    end = str(last.image) if last.root == first.root else f"{Path(last.root).name} {last.image}"
    return f"{len(part)} of {Path(first.root).name} {first.image} to {end}"


def _root(job: Job) -> str:
    return job.photos[0].root
