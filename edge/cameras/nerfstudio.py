# SPDX-License-Identifier: Apache-2.0
"""transforms.json of nerfstudio and its relatives: posed images, any number of cameras.

Its cameras look along -z with y up (OpenGL); its pixel centres lie at halves. Images have no times:
they are taken as a second apart, in the order of their names. The unit of the poses is not known.
"""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from edge.cameras.groundtruth import GroundTruth, rigid
from edge.cameras.images import is_file, read_grey
from edge.cameras.layout import Depths, Layout, Lenses
from edge.cameras.tables import a_second_apart, read_text
from edge.errors import ConfigError, RecordingError
from edge.geometry.camera import CameraModel
from edge.types import Mat4

_FILE = "transforms.json"
_OPENCV_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
_PINHOLES = ("SIMPLE_PINHOLE", "PINHOLE", "PERSPECTIVE", "SIMPLE_RADIAL", "RADIAL", "OPENCV")
_FISHEYES = ("OPENCV_FISHEYE", "FISHEYE")
_SUFFIXES = ("", ".png", ".jpg", ".jpeg")
_DEPTH_UNIT_M = 0.001

_Table = dict[str, Any]


def is_recording(root: Path) -> bool:
    """Tell whether `root` is such a folder."""
    return (root / _FILE).exists()


def read(root: Path) -> Layout:
    """Layout of the folder; RecordingError says what is wrong with it."""
    path = root / _FILE
    table = _load(path)
    frames = table.get("frames")
    if not isinstance(frames, list) or not frames:
        raise RecordingError(f"{path}: key 'frames' lists no image; the recording is empty")
    for number, frame in enumerate(frames):
        if not isinstance(frame, dict) or not isinstance(frame.get("file_path"), str):
            raise RecordingError(f"{path}: frame {number} has no 'file_path'; mend the file")
    frames = sorted(frames, key=lambda frame: str(frame["file_path"]))
    images = [_image(root, str(frame["file_path"])) for frame in frames]
    lenses = Lenses.of(
        [_camera(table, frame, image, path) for frame, image in zip(frames, images, strict=True)]
    )
    t_ns = a_second_apart(len(frames))
    return Layout(
        root=root,
        camera=lenses.cameras[0],
        rate_hz=1.0,
        t_ns=t_ns,
        images=tuple(images),
        groundtruth=lambda: GroundTruth.of(t_ns, [_pose(frame, path) for frame in frames]),
        depths=_depths(root, table, frames, path),
        lenses=lenses,
        metric=False,
    )


def _load(path: Path) -> _Table:
    try:
        table = json.loads(read_text(path))
    except (json.JSONDecodeError, RecursionError) as error:
        raise RecordingError(f"{path}: is no JSON ({error}); copy it anew") from None
    if not isinstance(table, dict):
        raise RecordingError(f"{path}: holds no table; copy it anew")
    return table


def _image(root: Path, name: str) -> Path:
    for suffix in _SUFFIXES:
        if is_file(root / f"{name}{suffix}"):
            return root / f"{name}{suffix}"
    return root / name


def _camera(table: _Table, frame: _Table, image: Path, path: Path) -> CameraModel:
    """Camera of a frame: its own keys, else those of the whole file."""
    keys = {**table, **frame}
    where = f"{path}: {frame['file_path']}"
    model = keys.get("camera_model", "OPENCV")
    k1, k2, k3, k4, p1, p2 = (
        _number(keys, key, where, 0.0) for key in ("k1", "k2", "k3", "k4", "p1", "p2")
    )
    if model in _PINHOLES and k4 == 0.0:
        kind = "radtan" if any((k1, k2, p1, p2, k3)) else "none"
        lens = (k1, k2, p1, p2, k3) if k3 else (k1, k2, p1, p2)
    elif model in _FISHEYES and p1 == p2 == 0.0:
        kind, lens = "equidistant", (k1, k2, k3, k4)
    else:
        lenses = ", ".join((*_PINHOLES, *_FISHEYES))
        raise RecordingError(
            f"{where}: model {model} with its k and p cannot be carried; use one of {lenses}"
        )
    width, height = _size(keys, image, where)
    if "fl_x" in keys:
        fx = _number(keys, "fl_x", where)
        fy = _number(keys, "fl_y", where, fx)
    else:
        fx = fy = 0.5 * width / math.tan(0.5 * _number(keys, "camera_angle_x", where))
    cx = _number(keys, "cx", where, 0.5 * width) - 0.5
    cy = _number(keys, "cy", where, 0.5 * height) - 0.5
    try:
        return CameraModel(width, height, fx, fy, cx, cy, kind, lens if kind != "none" else ())
    except ConfigError as error:
        raise RecordingError(f"{where}: {error}") from None


def _size(keys: _Table, image: Path, where: str) -> tuple[int, int]:
    if "w" in keys and "h" in keys:
        return round(_number(keys, "w", where)), round(_number(keys, "h", where))
    height, width = read_grey(image).shape
    return width, height


def _number(keys: _Table, key: str, where: str, default: float | None = None) -> float:
    value = keys.get(key, default)
    if value is None:
        raise RecordingError(f"{where}: key '{key}' is missing; add it")
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise RecordingError(f"{where}: key '{key}' is no finite number")
    return float(value)


def _pose(frame: _Table, path: Path) -> Mat4:
    where = f"{path}: transform_matrix of {frame['file_path']}"
    return rigid(frame.get("transform_matrix"), where) @ _OPENCV_OPENGL


def _depths(root: Path, table: _Table, frames: list[_Table], path: Path) -> Depths | None:
    names = [frame.get("depth_file_path") for frame in frames]
    if not any(names):
        return None
    unit = _number(table, "depth_unit_scale_factor", str(path), _DEPTH_UNIT_M)
    files = tuple(root / name if isinstance(name, str) and name else None for name in names)
    return Depths(files, unit, in_pose_units=True)
