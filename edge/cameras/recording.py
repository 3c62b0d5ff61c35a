# SPDX-License-Identifier: Apache-2.0
"""Recordings as cameras: which format a folder has, and its frames one by one."""

import logging
from collections.abc import Callable, Iterator, Sequence
from functools import cached_property, partial
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from edge.cameras import colmap, euroc, images, kitti, nerfstudio, photos, seven_scenes, tum
from edge.cameras.groundtruth import GroundTruth
from edge.cameras.layout import Files, ImageFile, Layout
from edge.cameras.tables import I64
from edge.errors import RecordingError
from edge.geometry.camera import CameraModel
from edge.types import F32, U8, Frame, Mat4

log = logging.getLogger(__name__)

Image = TypeVar("Image", U8, F32)
File = TypeVar("File", bound=ImageFile)

# Further files are counted without a line each, so that a wrong camera.toml says so once.
_MAX_LINES = 10

# The project's own last: others add a rgb/ or a camera.toml to theirs.
_FORMATS = (euroc, kitti, colmap, nerfstudio, seven_scenes, photos, tum)


def open_recording(
    path: str | Path, *, frames: slice | None = None, stride: int = 1, reverse: bool = False
) -> "Recording":
    """Open the recording in the folder or file `path` for play: slice, then stride, then reverse.

    It may be this project's sequence folder or one of TUM RGB-D (rgb.txt), EuRoC ASL
    (mav0/cam0/data.csv), KITTI odometry (times.txt, image_0/), 7-Scenes (frame-000000.color.png),
    COLMAP (sparse/0/, images/) or nerfstudio (transforms.json), photos beside a camera.toml, or
    what `mapvo record` wrote.
    RecordingError says in one line what is wrong with it.
    """
    root = Path(path)
    if root.suffix == ".mcap" or any(root.glob("*.mcap")):
        from edge.cameras import mcap  # with decompressors that few need

        if mcap.is_recording(root):
            return Recording(mcap.read(root), frames=frames, stride=stride, reverse=reverse)
    if not root.is_dir():
        there = "is no recording" if root.exists() else "does not exist"
        raise RecordingError(f"{root}: {there}; give the folder of a recording, or its FILE.mcap")
    for format_ in _FORMATS:
        if format_.is_recording(root):
            return Recording(format_.read(root), frames=frames, stride=stride, reverse=reverse)
    expected = (
        "rgb.txt, mav0/cam0/data.csv (EuRoC), times.txt with image_0/ (KITTI), "
        "frame-000000.color.png (7-Scenes), sparse/ (COLMAP), transforms.json (nerfstudio) or "
        "photos with camera.toml"
    )
    raise RecordingError(f"{root}: is no recording; expected {expected}")


class Recording:
    """A recorded camera; iterating plays the chosen frames, as often as asked.

    Frames keep their place in the whole recording as `index`, and every method and array here
    goes by it. Images are raw: grey, distorted, read-only.

    A file that is missing, empty, cut short, undecodable or of another size than its camera
    gives None; a frame without its image is left out of the play. Each such file has one line in
    the log (the first ten; the rest are counted), once there is one that can be read. `dropped`
    counts frames without an image. If no chosen frame has one, playing ends with RecordingError.

    Owned by one thread.
    """

    def __init__(
        self, layout: Layout, *, frames: slice | None = None, stride: int = 1, reverse: bool = False
    ) -> None:
        self._layout = layout
        self._failed: dict[ImageFile, str] = {}
        self._any_read = True  # while nothing has been played yet, each failure is told at once
        self._dropped: set[int] = set()
        self.indices = _choose(layout, frames, stride, reverse)

    @property
    def root(self) -> Path:
        """Folder of the recording."""
        return self._layout.root

    @property
    def camera(self) -> CameraModel:
        """Calibration of the first camera."""
        return self._layout.camera

    @property
    def cameras(self) -> tuple[CameraModel, ...]:
        """Calibrations of all cameras that took the images."""
        return self._layout.lenses.cameras if self._layout.lenses else (self.camera,)

    def camera_at(self, index: int) -> CameraModel:
        """Calibration of the camera that took an image."""
        lenses = self._layout.lenses
        return lenses.cameras[lenses.of_image[index]] if lenses else self.camera

    @property
    def metric(self) -> bool:
        """Whether the true poses are in metres, not in a unit of their own."""
        return self._layout.metric

    @property
    def depth_in_pose_units(self) -> bool:
        """Whether `depth` is in the unit of the true poses, even where that is not metres."""
        return self._layout.depths is not None and self._layout.depths.in_pose_units

    @property
    def rate_hz(self) -> float:
        """Nominal frame rate."""
        return self._layout.rate_hz

    @property
    def t_ns(self) -> I64:
        """Times (n,) int64 of all frames, chosen or not; `t_ns[frame.index] == frame.t_ns`."""
        return self._layout.t_ns

    @property
    def dropped(self) -> int:
        """How many frames had no image that could be read, among those asked for so far."""
        return len(self._dropped)

    @cached_property
    def groundtruth(self) -> GroundTruth | None:
        """True poses (`t_ns`, `T_world_cam`), or None; read when first asked for."""
        return self._layout.groundtruth()

    @property
    def right_camera(self) -> CameraModel | None:
        """Calibration of the right camera, or None."""
        return self._layout.right.camera if self._layout.right else None

    @property
    def T_left_right(self) -> Mat4 | None:  # a transform
        """Takes points of the right camera to the left one, or None."""
        return self._layout.right.T_left_right if self._layout.right else None

    @property
    def T_cam_lidar(self) -> Mat4 | None:  # a transform
        """Takes points of the laser scanner to the camera, or None."""
        return self._layout.lidar.T_cam_lidar if self._layout.lidar else None

    @property
    def has_depth(self) -> bool:
        """Whether some frame comes with a depth image."""
        return self._layout.depths is not None and any(self._layout.depths.images)

    def __len__(self) -> int:
        return len(self.indices)

    def __iter__(self) -> Iterator[Frame]:
        if len(self.cameras) > 1:
            message = f"is of {len(self.cameras)} cameras; images of one camera can be played"
            raise RecordingError(f"{self.root}: {message}")
        played = 0
        self._any_read = bool(self._failed)
        for index in map(int, self.indices):
            if (image := self.image(index)) is not None:
                played += 1
                yield Frame(index, int(self.t_ns[index]), image, colour=partial(self.colour, index))
        self._any_read = True
        if played == 0:
            first = next(iter(self._failed.values()), "")
            message = f"none of the {len(self)} chosen images can be used: {first}"
            raise RecordingError(f"{self.root}: {message}")

    def image(self, index: int) -> U8 | None:
        """Grey image (h, w) uint8 of a frame; None where it cannot be read."""
        image = self._read(self._layout.images[index], images.read_grey, self.camera_at(index))
        if image is None:
            self._dropped.add(index)
        return image

    def needed_image(self, index: int) -> U8:
        """Grey image (h, w) uint8 of a frame; RecordingError says why it cannot be read."""
        camera = self.camera_at(index)
        path = self._layout.images[index]
        try:
            image = images.read_grey(path)
            images.check_size(path, image, camera.width, camera.height)
        except RecordingError as error:
            message = f"{error}; mend image {index}, or leave it out with --exclude {index}"
            raise RecordingError(message) from None
        image.flags.writeable = False
        return image

    def image_file(self, index: int) -> ImageFile:
        """Where the image of a frame is stored."""
        return self._layout.images[index]

    def colour(self, index: int) -> U8 | None:
        """Image (h, w, 3) uint8, red first; None where it cannot be read."""
        return self._read(self._layout.images[index], images.read_rgb, self.camera_at(index))

    def right(self, index: int) -> U8 | None:
        """Grey image of the right camera; None where there is none or it cannot be read."""
        rig = self._layout.right
        if rig is None:
            return None
        return self._read(rig.images[index], images.read_grey, rig.camera)

    def depth(self, index: int) -> F32 | None:
        """Depth along z (h, w) float32 [m], 0 where unknown; None where there is none."""
        depths = self._layout.depths
        if depths is None:
            return None
        scale, camera = depths.metres_per_unit, self.camera_at(index)

        def read(path: Path) -> F32:
            if path.suffix == ".bin":
                return colmap.read_depth(path, camera)
            return images.read_depth(path, scale)

        return self._read(depths.images[index], read, camera)

    def lidar_file(self, index: int) -> Path | None:
        """File of the laser scan of a frame, or None."""
        scans: Files = self._layout.lidar.scans if self._layout.lidar else ()
        return scans[index] if scans else None

    def files(self, index: int) -> list[ImageFile]:
        """All files of a frame: its images, depth and scan."""
        layout = self._layout
        rows: list[Sequence[ImageFile | None]] = [layout.images]
        rows += [layout.depths.images] if layout.depths else []
        rows += [layout.right.images] if layout.right else []
        rows += [layout.lidar.scans] if layout.lidar else []
        return [path for row in rows if row and (path := row[index]) is not None]

    def _read(
        self, path: File | None, reader: Callable[[File], Image], camera: CameraModel
    ) -> Image | None:
        if path is None:
            return None
        try:
            image = reader(path)
            images.check_size(path, image, camera.width, camera.height)
        except RecordingError as error:
            self._report(path, error)
            return None
        image.flags.writeable = False
        if not self._any_read:
            self._any_read = True
            self._log(list(self._failed.values()))
        return image

    def _report(self, path: ImageFile, error: RecordingError) -> None:
        if path in self._failed:
            return
        self._failed[path] = str(error)
        if self._any_read:
            self._log([str(error)])

    def _log(self, errors: list[str]) -> None:
        """Say why the last few files failed."""
        before = len(self._failed) - len(errors)
        for error in errors[: max(_MAX_LINES - before, 0)]:
            log.warning("image skipped: %s", error)
        if errors and before < _MAX_LINES <= len(self._failed):
            log.warning("image skipped: further ones are only counted")


def _choose(layout: Layout, frames: slice | None, stride: int, reverse: bool) -> NDArray[np.int64]:
    """Indices of the frames to play, in order of play."""
    if stride < 1:
        raise RecordingError(f"stride: {stride} is impossible; give 1 or more")
    n = len(layout.images)
    chosen = np.arange(n)[frames or slice(None)][::stride]
    if len(chosen) == 0:
        span = f"{frames.start or 0}:{n if frames.stop is None else frames.stop}" if frames else ":"
        raise RecordingError(f"frames {span}: hold none of the {n} frames of {layout.root}")
    return chosen[::-1] if reverse else chosen
