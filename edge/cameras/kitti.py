# SPDX-License-Identifier: Apache-2.0
"""KITTI odometry sequences: sequences/00 with times.txt, calib.txt, image_0, image_1, velodyne.

Images are rectified. Without the grey pair (image_0, image_1) the colour one (image_2, image_3) is
taken. Poses are those of ../../poses/00.txt, which are of the left grey camera, moved to the camera
that is played.
"""

import logging
from pathlib import Path

import numpy as np

from edge.cameras.groundtruth import GroundTruth, rigid
from edge.cameras.images import read_grey
from edge.cameras.layout import Files, Layout, Lidar, StereoRig
from edge.cameras.tables import I64, increasing, median_rate_hz, read_rows
from edge.errors import ConfigError, RecordingError
from edge.geometry import se3, so3
from edge.geometry.camera import CameraModel
from edge.types import F64, Mat4

_PAIRS = ((0, 1), (2, 3))
_RATE_HZ = 10.0

log = logging.getLogger(__name__)


def is_recording(root: Path) -> bool:
    """Tell whether `root` is meant to be such a sequence, complete or not."""
    return (root / "times.txt").exists() or any(_folder(root, left).is_dir() for left, _ in _PAIRS)


def read(root: Path) -> Layout:
    """Layout of the sequence; RecordingError says what is wrong with it."""
    rows = list(read_rows(root / "times.txt"))
    if not rows:
        raise RecordingError(f"{root / 'times.txt'}: holds no time; the recording is empty")
    t_ns = increasing([row.time_ns() for row in rows], rows)
    left, right = next((pair for pair in _PAIRS if _folder(root, pair[0]).is_dir()), (None, None))
    if left is None or right is None:
        raise RecordingError(f"{root / 'image_0'}: is missing; the recording has no images")
    calibration = _read_calibration(root / "calib.txt")
    n = _count(_folder(root, left), len(t_ns))
    images = _numbered(_folder(root, left), n)
    camera, T_grey_left = _camera(root, calibration, left, images)
    return Layout(
        root=root,
        camera=camera,
        rate_hz=median_rate_hz(t_ns) or _RATE_HZ,
        t_ns=t_ns[:n],
        images=images,
        groundtruth=lambda: _read_poses(root, t_ns, T_grey_left),
        right=_read_right(root, calibration, right, T_grey_left, n),
        lidar=_read_lidar(root, calibration, T_grey_left, n),
    )


def _folder(root: Path, number: int) -> Path:
    return root / f"image_{number}"


def _count(folder: Path, n_times: int) -> int:
    """How many frames there are: the images may end before the times, but not after them."""
    suffix = _suffix(folder)
    numbers = (path.stem for path in folder.glob(f"*{suffix}"))
    n = max((int(name) + 1 for name in numbers if name.isdecimal()), default=n_times)
    if n > n_times:
        message = f"has an image {n - 1:06d}{suffix}, times.txt has {n_times} times"
        raise RecordingError(f"{folder}: {message}; take both from one set")
    if n < n_times:
        log.warning("event=recording_ends_early folder=%s images=%d times=%d", folder, n, n_times)
    return n


def _suffix(folder: Path) -> str:
    return ".jpg" if (folder / "000000.jpg").exists() else ".png"


def _numbered(folder: Path, n: int) -> tuple[Path, ...]:
    """Image files 000000.png onward."""
    suffix = _suffix(folder)
    return tuple(folder / f"{i:06d}{suffix}" for i in range(n))


def _read_calibration(path: Path) -> dict[str, F64]:
    """Projections (3, 4) by name: P0 to P3, and Tr from the scanner to the left grey camera."""
    table = {}
    for row in read_rows(path):
        if row.cells[0].startswith(("P", "Tr")):
            table[row.cells[0].rstrip(":")] = np.array(row.numbers(1, 13)).reshape(3, 4)
    return table


def _camera(
    root: Path, calibration: dict[str, F64], number: int, images: tuple[Path, ...]
) -> tuple[CameraModel, Mat4]:
    """Camera model and T_grey_cam of a camera; its size is that of its first readable image."""
    path = root / "calib.txt"
    P = calibration.get(f"P{number}")
    if P is None:
        raise RecordingError(f"{path}: line 'P{number}:' is missing; copy it from the data set")
    height, width = _first_size(images)
    try:
        camera = CameraModel(width, height, P[0, 0], P[1, 1], P[0, 2], P[1, 2])
    except ConfigError as error:
        raise RecordingError(f"{path}: P{number}: {error}") from None
    try:
        t_grey_cam = -np.linalg.solve(P[:, :3], P[:, 3])
    except np.linalg.LinAlgError:
        message = f"{path}: P{number}: is no projection; copy it from the data set"
        raise RecordingError(message) from None
    return camera, se3.from_rotation_translation(np.eye(3), t_grey_cam)


def _first_size(images: tuple[Path, ...]) -> tuple[int, int]:
    reason: RecordingError | None = None
    for path in images:
        try:
            height, width = read_grey(path).shape
        except RecordingError as error:
            reason = reason or error
        else:
            return height, width
    raise RecordingError(f"{images[0].parent}: no image can be read; the first says: {reason}")


def _read_right(
    root: Path, calibration: dict[str, F64], number: int, T_grey_left: Mat4, n: int
) -> StereoRig | None:
    folder = _folder(root, number)
    if not folder.is_dir():
        return None
    images = _numbered(folder, n)
    camera, T_grey_right = _camera(root, calibration, number, images)
    return StereoRig(camera, se3.inverse(T_grey_left) @ T_grey_right, images)


def _read_lidar(root: Path, calibration: dict[str, F64], T_grey_left: Mat4, n: int) -> Lidar | None:
    folder, Tr = root / "velodyne", calibration.get("Tr")
    if not folder.is_dir() or Tr is None:
        return None
    paths = (folder / f"{i:06d}.bin" for i in range(n))
    scans: Files = tuple(path if path.exists() else None for path in paths)
    T_grey_lidar = se3.from_rotation_translation(so3.normalise(Tr[:, :3]), Tr[:, 3])
    return Lidar(scans, se3.inverse(T_grey_left) @ T_grey_lidar)


def _read_poses(root: Path, t_ns: I64, T_grey_left: Mat4) -> GroundTruth | None:
    root = root.resolve()
    path = root.parent.parent / "poses" / f"{root.name}.txt"
    if not path.exists():
        return None
    T = np.tile(np.eye(4), (len(t_ns), 1, 1))
    rows = list(read_rows(path))
    if len(rows) != len(t_ns):
        message = f"has {len(rows)} poses, times.txt has {len(t_ns)} times; take both from one set"
        raise RecordingError(f"{path}: {message}")
    for T_world_grey, row in zip(T, rows, strict=True):
        T_world_grey[:] = rigid(np.array(row.numbers(0, 12)).reshape(3, 4), row.where)
    return GroundTruth(t_ns, T @ T_grey_left)
