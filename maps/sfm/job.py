# SPDX-License-Identifier: Apache-2.0
"""What the process of COLMAP is told, as a file.

COLMAP is given pixels of the ideal camera, so that it needs no lens model of ours, and with v
stretched by fx / fy, so that one focal length will do. Where the calibration knows no lens, it may
find one coefficient of distortion.
"""

from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np

from edge.errors import OutputError
from edge.geometry.camera import CameraModel
from edge.types import F32, F64

FILE_NAME = "job.json"
DATABASE = "database.db"
MODELS = "models"
_LEAST_MOVE_PX = 0.3  # in the corners of the image: less is as well the noise of SIFT


class Photo(NamedTuple):
    """One image without a pose."""

    root: str  # of its recording
    image: int  # in it
    camera: int  # in Job.cameras


class Job(msgspec.Struct, frozen=True, kw_only=True):
    """All that the process needs."""

    photos: list[Photo]
    cameras: list[CameraModel]
    pairs: list[tuple[int, int]]
    refine_lens: bool
    threads: int


def write(job: Job, folder: Path) -> None:
    """Write the job into the folder."""
    try:
        (folder / FILE_NAME).write_bytes(msgspec.json.encode(job))
    except OSError as error:
        raise OutputError(f"{folder}: cannot be written ({error.strerror}); make room") from None


def read(folder: Path) -> Job:
    """Read the job in the folder."""
    return msgspec.json.decode((folder / FILE_NAME).read_bytes(), type=Job)


def may_refine(job: Job, camera: int) -> bool:
    """Tell whether a camera's lens is to be found."""
    return job.refine_lens and job.cameras[camera].distortion_model == "none"


def to_colmap(camera: CameraModel, raw: F32) -> F64:
    """COLMAP's pixels (n, 2) of raw pixels (n, 2); nan where the lens has no inverse."""
    ideal = camera.undistort_pixels(raw)
    ideal[:, 1] = camera.cy + (ideal[:, 1] - camera.cy) * (camera.fx / camera.fy)
    return ideal + 0.5


def from_colmap(camera: CameraModel, pixels: F64) -> F64:
    """Raw pixels (n, 2) of those that `to_colmap` gave, less the half pixel."""
    ideal = np.array(pixels)
    ideal[:, 1] = camera.cy + (ideal[:, 1] - camera.cy) * (camera.fy / camera.fx)
    return camera.distort_pixels(ideal)


def with_k1(camera: CameraModel, k1: float) -> CameraModel:
    """The camera with the one coefficient that COLMAP found, where it makes a difference."""
    x, y = (camera.width / (2.0 * camera.fx), camera.height / (2.0 * camera.fy))
    if abs(k1) * camera.fx * np.hypot(x, y) ** 3 < _LEAST_MOVE_PX:
        return camera
    return CameraModel(
        camera.width,
        camera.height,
        camera.fx,
        camera.fy,
        camera.cx,
        camera.cy,
        distortion_model="radtan",
        distortion=(k1, 0.0, 0.0, 0.0),
    )
