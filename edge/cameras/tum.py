# SPDX-License-Identifier: Apache-2.0
"""The sequence folder of this project and TUM RGB-D, its model.

    rgb.txt             time_s path
    camera.toml         width height fx fy cx cy distortion_model distortion rate_hz
    depth.txt           time_s path; 16-bit PNG, z in mm, 0 = unknown   (optional)
    groundtruth.txt     time_s tx ty tz qx qy qz qw, camera-to-world    (optional)
    right/, camera_right.toml   images of the same names                (optional)

A TUM RGB-D folder has no camera.toml: its camera is known by fr1, fr2 or fr3 in the folder's name,
and its depth counts 5000 to the metre, which is told by the line `# file: ...bag` in depth.txt.
"""

import re
from pathlib import Path

import numpy as np

from edge.cameras import groundtruth
from edge.cameras.groundtruth import GroundTruth
from edge.cameras.layout import Depths, Layout, StereoRig
from edge.cameras.tables import I64, increasing, known_rate_hz, nearest, read_rows, read_text
from edge.errors import ConfigError, RecordingError
from edge.geometry.camera import CameraFile, CameraModel, load_camera_file

# Colour cameras as calibrated by the authors of the TUM RGB-D benchmark (Sturm et al. 2012).
_FREIBURG = {
    "1": CameraModel(
        *(640, 480, 517.306408, 516.469215, 318.643040, 255.313989, "radtan"),
        (0.262383, -0.953104, -0.005358, 0.002628, 1.163314),
    ),
    "2": CameraModel(
        *(640, 480, 520.908620, 521.007327, 325.141442, 249.701764, "radtan"),
        (0.231222, -0.784899, -0.003257, -0.000105, 0.917205),
    ),
    "3": CameraModel(640, 480, 535.4, 539.2, 320.1, 247.6),
}
_FREIBURG_RATE_HZ = 30.0
_TUM_UNITS_PER_M, _UNITS_PER_M = 5000.0, 1000.0
# The benchmark's own association takes pairs up to 20 ms apart; half a frame is the limit for
# quick cameras, where a depth would else go to its neighbours too.
_MAX_PAIR_NS = 20_000_000


def is_recording(root: Path) -> bool:
    """Tell whether `root` is meant to be such a folder, complete or not."""
    return any((root / name).exists() for name in ("rgb.txt", "camera.toml", "rgb"))


def read(root: Path) -> Layout:
    """Layout of the folder; RecordingError says what is wrong with it."""
    t_ns, images = _read_list(root, root / "rgb.txt")
    if not images:
        raise RecordingError(f"{root / 'rgb.txt'}: lists no image; the recording is empty")
    file = _read_camera(root)
    return Layout(
        root=root,
        camera=file.camera,
        rate_hz=known_rate_hz(file.rate_hz, t_ns, root / "camera.toml"),
        t_ns=t_ns,
        images=images,
        groundtruth=lambda: _read_groundtruth(root),
        depths=_read_depths(root, t_ns),
        right=_read_right(root, images),
    )


def _read_list(root: Path, path: Path) -> tuple[I64, tuple[Path, ...]]:
    rows = list(read_rows(path, max_cells=2))
    for row in rows:
        if len(row.cells) < 2:
            raise row.error("has no path after the time")
    t_ns = increasing([row.time_ns() for row in rows], rows)
    return t_ns, tuple(root / row.cells[1] for row in rows)


def _read_camera(root: Path) -> CameraFile:
    path = root / "camera.toml"
    if path.exists():
        return _load(path)
    if (match := re.search(r"(?:freiburg|fr)([123])", root.resolve().name)) is not None:
        return CameraFile(_FREIBURG[match[1]], _FREIBURG_RATE_HZ, None)
    message = "is missing and the folder's name tells no TUM RGB-D camera (fr1 fr2 fr3)"
    raise RecordingError(f"{path}: {message}; write width height fx fy cx cy into it")


def _load(path: Path) -> CameraFile:
    try:
        return load_camera_file(path)
    except ConfigError as error:
        raise RecordingError(str(error)) from None


def _read_groundtruth(root: Path) -> GroundTruth | None:
    path = root / "groundtruth.txt"
    return groundtruth.read_tum(path) if path.exists() else None


def _read_depths(root: Path, t_ns: I64) -> Depths | None:
    path = root / "depth.txt"
    if not path.exists():
        return None
    depth_t_ns, images = _read_list(root, path)
    half_gap_ns = int(np.median(np.diff(t_ns))) // 2 if len(t_ns) > 1 else _MAX_PAIR_NS
    pairs = nearest(t_ns, depth_t_ns, min(_MAX_PAIR_NS, half_gap_ns))
    from_tum = re.search(r"^#\s*file:.*\.bag", read_text(path), re.MULTILINE) is not None
    units_per_m = _TUM_UNITS_PER_M if from_tum else _UNITS_PER_M
    return Depths(tuple(images[j] if j >= 0 else None for j in pairs), 1.0 / units_per_m)


def _read_right(root: Path, images: tuple[Path, ...]) -> StereoRig | None:
    folder, path = root / "right", root / "camera_right.toml"
    if not folder.is_dir():
        return None
    file = _load(path)
    if file.T_left_right is None:
        raise RecordingError(f"{path}: key 'T_left_right' is missing; add the right camera's pose")
    return StereoRig(file.camera, file.T_left_right, tuple(folder / image.name for image in images))
