# SPDX-License-Identifier: Apache-2.0
"""What structure from motion found, kept in a file: COLMAP does not find it twice the same."""

from hashlib import sha256
from pathlib import Path

import msgspec

from edge.cameras.recording import open_recording
from edge.errors import OutputError, RecordingError, TileError
from edge.store import durable
from edge.tiles import format as tile_format
from maps.sfm.job import Job
from maps.sfm.solve import SfmResult
from maps.work_folder import joined, taken_apart

_KEY = "images"  # the hash of what it was found from


def identity(job: Job) -> str:
    """Hash of the images and cameras; not of the pairs and settings that led to the result."""
    digest = sha256(msgspec.json.encode([job.cameras, job.refine_lens]))
    recordings = {place.root: open_recording(place.root) for place in job.photos}
    for place in job.photos:
        digest.update(msgspec.json.encode((place.image, place.camera)))
        for path in recordings[place.root].files(place.image)[:1]:
            digest.update(sha256(path.read_bytes()).digest())
    return digest.hexdigest()


def load(path: Path, job: Job) -> SfmResult | None:
    """The result in the file; None if there is no such file yet."""
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        return None
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {error.strerror}") from None
    try:
        arrays, metadata = tile_format.decode(memoryview(data), str(path))
        result = joined(SfmResult, arrays)
    except (TileError, KeyError):
        raise RecordingError(
            f"{path}: holds no poses that --poses sfm found; give --sfm another file"
        ) from None
    if metadata.get(_KEY) != identity(job):
        raise RecordingError(
            f"{path}: holds the poses of other images or another calibration; remove it, or give "
            "--sfm another file"
        )
    return result


def save(path: Path, job: Job, result: SfmResult) -> None:
    """Write the file, whole or not at all."""
    data = tile_format.encode(taken_apart(result), {_KEY: identity(job)})
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        durable.write_whole(path, data)
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror}); choose another") from None
