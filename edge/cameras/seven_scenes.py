# SPDX-License-Identifier: Apache-2.0
"""7-Scenes sequences: frame-000000.color.png, frame-000000.pose.txt (camera-to-world).

The colour camera has no calibration file: the authors' 525 px stand for it unless a camera.toml
lies in the folder. The depth images are the depth camera's, 2 cm beside, and are left aside.
"""

from pathlib import Path

import numpy as np

from edge.cameras.groundtruth import GroundTruth, rigid
from edge.cameras.layout import Layout
from edge.cameras.tables import I64, read_rows
from edge.errors import ConfigError, RecordingError
from edge.geometry.camera import CameraFile, CameraModel, load_camera_file
from edge.types import Mat4

_COLOUR = ".color.png"
_CAMERA = CameraModel(640, 480, 525.0, 525.0, 319.5, 239.5)
_RATE_HZ = 30


def is_recording(root: Path) -> bool:
    """Tell whether `root` is such a sequence."""
    return next(root.glob(f"frame-*{_COLOUR}"), None) is not None


def read(root: Path) -> Layout:
    """Layout of the sequence; RecordingError says what is wrong with it."""
    images = sorted(root.glob(f"frame-*{_COLOUR}"))
    t_ns = _times(images)
    file = _camera(root)
    return Layout(
        root=root,
        camera=file.camera,
        rate_hz=file.rate_hz or float(_RATE_HZ),
        t_ns=t_ns,
        images=tuple(images),
        groundtruth=lambda: _poses(images, t_ns),
    )


def _times(images: list[Path]) -> I64:
    """Times (n,) by the numbers in the names."""
    numbers = []
    for path in images:
        text = path.name.removeprefix("frame-").removesuffix(_COLOUR)
        if not text.isascii() or not text.isdigit() or len(text) > 9:
            raise RecordingError(f"{path}: its name has no number as in frame-000000{_COLOUR}")
        numbers.append(int(text))
    return np.array(numbers, np.int64) * 1_000_000_000 // _RATE_HZ


def _camera(root: Path) -> CameraFile:
    path = root / "camera.toml"
    if not path.exists():
        return CameraFile(_CAMERA, None, None)
    try:
        return load_camera_file(path)
    except ConfigError as error:
        raise RecordingError(str(error)) from None


def _poses(images: list[Path], t_ns: I64) -> GroundTruth | None:
    """Poses of the frames that have one; None where no frame has."""
    files = [path.with_name(path.name.replace(_COLOUR, ".pose.txt")) for path in images]
    found = [i for i, path in enumerate(files) if path.exists()]
    if not found:
        return None
    return GroundTruth.of(t_ns[found], [_pose(files[i]) for i in found])


def _pose(path: Path) -> Mat4:
    return rigid([row.numbers(0, 4) for row in read_rows(path)], str(path))
