# SPDX-License-Identifier: Apache-2.0
"""What a reader of one recording format finds: which files, when, by which camera."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from edge.cameras.groundtruth import GroundTruth
from edge.cameras.tables import I64
from edge.geometry.camera import CameraModel
from edge.types import Mat4

Files = tuple[Path | None, ...]


class ImageFile(Protocol):
    """A file, or something in one; as text it names itself."""

    def read_bytes(self) -> bytes:
        """Bytes of a whole image file."""
        ...

    def __hash__(self) -> int: ...


@dataclass(frozen=True, slots=True, eq=False)
class StereoRig:
    """The right camera beside the first one."""

    camera: CameraModel
    T_left_right: Mat4
    images: Files  # one for each frame of the first camera


@dataclass(frozen=True, slots=True, eq=False)
class Depths:
    """Depth images in the first camera."""

    images: Files
    metres_per_unit: float
    in_pose_units: bool = False  # made with the poses: of their unit, whatever that is


@dataclass(frozen=True, slots=True, eq=False)
class Lenses:
    """The cameras of a collection of images, and which image is of which."""

    cameras: tuple[CameraModel, ...]
    of_image: tuple[int, ...]  # one for each image

    @classmethod
    def of(cls, cameras: Sequence[CameraModel]) -> "Lenses":
        """Cameras (n) of n images, equal ones put together."""
        distinct = tuple(dict.fromkeys(cameras))
        number = {camera: i for i, camera in enumerate(distinct)}
        return cls(distinct, tuple(number[camera] for camera in cameras))


@dataclass(frozen=True, slots=True, eq=False)
class Lidar:
    """Scans and where the scanner sits."""

    scans: Files
    T_cam_lidar: Mat4


@dataclass(frozen=True, slots=True, eq=False)
class Layout:
    """A whole recording, nothing decoded yet.

    `groundtruth` is a call, so that a run that needs no truth neither waits for it nor fails by it.
    """

    root: Path
    camera: CameraModel
    rate_hz: float
    t_ns: I64  # (n,) increasing
    images: tuple[ImageFile, ...]  # n
    groundtruth: Callable[[], GroundTruth | None]
    depths: Depths | None = None
    right: StereoRig | None = None
    lidar: Lidar | None = None
    lenses: Lenses | None = None  # where images are of several cameras; `camera` is the first
    metric: bool = True  # poses are in metres; else in a unit of their own
