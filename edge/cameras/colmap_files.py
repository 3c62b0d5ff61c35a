# SPDX-License-Identifier: Apache-2.0
"""The files of a COLMAP model: cameras, images and points3D, binary or text.

COLMAP's pixel centres lie at halves and its poses take points to the camera; here both are ours
already: centres on integers, T_world_cam. No length in a file is believed before it is checked
against the file's size.
"""

import struct
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edge.cameras.colmap_cameras import MODELS, camera_of
from edge.cameras.tables import read_rows, read_text
from edge.errors import RecordingError
from edge.geometry import so3
from edge.geometry.camera import CameraModel
from edge.types import F32, F64, Mat4

I64 = NDArray[np.int64]

_OBSERVATION = np.dtype([("pixel", "<f8", 2), ("point", "<i8")])
_MAX_NAME = 4096
_MAX_SIDE_PX = 1 << 15
_MAX_POSE = 1e12  # of the model's units; nothing is that far away


class ModelImage(NamedTuple):
    """One registered image."""

    number: int  # COLMAP's image id
    name: str  # its path within the folder of images
    camera: int  # COLMAP's camera id
    T_world_cam: Mat4
    pixels: F64  # (m, 2) features that show a point
    point: I64  # (m,) id of that point


class Points(NamedTuple):
    """The points of a model."""

    number: I64  # (n,) COLMAP's ids, ascending
    xyz: F64  # (n, 3)


def has_model(folder: Path) -> bool:
    """Tell whether cameras and images lie in `folder`, in either form."""
    return any((folder / f"images{s}").exists() for s in (".bin", ".txt"))


def read_cameras(folder: Path) -> dict[int, CameraModel]:
    """Cameras by their id; RecordingError names one that cannot be carried."""
    path = _file(folder, "cameras")
    rows = _binary_cameras(path) if path.suffix == ".bin" else _text_cameras(path)
    return {
        number: camera_of(name, width, height, parameters, f"{path}: camera {number}")
        for number, name, width, height, parameters in rows
    }


def read_images(folder: Path) -> list[ModelImage]:
    """Images with their poses, in the order of their names."""
    path = _file(folder, "images")
    images = _binary_images(path) if path.suffix == ".bin" else _text_images(path)
    if not images:
        raise RecordingError(f"{path}: holds no image; give a model with images")
    names = {image.name for image in images}
    if len(names) != len(images):
        raise RecordingError(f"{path}: names an image twice; give one model alone")
    return sorted(images, key=lambda image: image.name)


def read_points(folder: Path) -> Points:
    """All points of the model."""
    path = _file(folder, "points3D")
    if path.suffix == ".bin":
        number, xyz = _binary_points(path)
    else:
        rows = list(read_rows(path))
        number = np.array([_whole(row.cells[0], str(path)) for row in rows], np.int64)
        xyz = np.array([row.numbers(1, 4) for row in rows]).reshape(-1, 3)
    order = np.argsort(number, kind="stable")
    return Points(number[order], xyz[order])


def read_depth(path: Path, data: bytes) -> F32:
    """Depth along z (h, w) float32 of a depth map of COLMAP's, 0 where unknown."""
    head = data[:64].split(b"&", 3)
    if len(head) < 4 or not all(part.isdigit() and len(part) < 6 for part in head[:3]):
        raise RecordingError(f"{path}: is no depth map of COLMAP's; copy it anew from its origin")
    width, height, channels = map(int, head[:3])
    start = sum(len(part) + 1 for part in head[:3])
    if channels != 1 or not (0 < width <= _MAX_SIDE_PX and 0 < height <= _MAX_SIDE_PX):
        raise RecordingError(f"{path}: {width}x{height}x{channels} is no depth map's size")
    if len(data) - start != 4 * width * height:
        raise RecordingError(f"{path}: is cut short")
    depth = np.frombuffer(data, "<f4", offset=start).reshape(height, width)
    known = np.isfinite(depth) & (depth > 0.0)
    clean: F32 = np.where(known, depth, 0.0).astype(np.float32)
    return clean


def _file(folder: Path, stem: str) -> Path:
    for suffix in (".bin", ".txt"):
        if (folder / f"{stem}{suffix}").exists():
            return folder / f"{stem}{suffix}"
    raise RecordingError(f"{folder / stem}.bin: is missing; the COLMAP model is incomplete")


class _Bytes:
    """A binary file, read from its start to its end."""

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            self._data = path.read_bytes()
        except OSError as error:
            raise RecordingError(f"{path}: cannot be read: {error.strerror}") from None
        self._at = 0

    def take(self, form: str) -> tuple[int | float, ...]:
        size = struct.calcsize("<" + form)
        return struct.unpack("<" + form, self._piece(size))

    def count(self, least_size: int) -> int:
        """A number of records that may be as many as the rest of the file holds."""
        (count,) = self.take("Q")
        if count * least_size > len(self._data) - self._at:
            raise self.error()
        return int(count)

    def name(self) -> str:
        end = self._data.find(b"\0", self._at, self._at + _MAX_NAME)
        if end < 0:
            raise self.error()
        text = self._piece(end + 1 - self._at)[:-1]
        try:
            return text.decode("utf-8")
        except UnicodeDecodeError:
            raise self.error() from None

    def array(self, dtype: np.dtype[np.void], count: int) -> NDArray[np.void]:
        return np.frombuffer(self._piece(dtype.itemsize * count), dtype)

    def skip(self, size: int) -> None:
        self._piece(size)

    def error(self) -> RecordingError:
        return RecordingError(f"{self.path}: is damaged or cut short; copy it anew from its origin")

    def _piece(self, size: int) -> bytes:
        if size > len(self._data) - self._at:
            raise self.error()
        self._at += size
        return self._data[self._at - size : self._at]


_CameraRow = tuple[int, str, int, int, list[float]]


def _binary_cameras(path: Path) -> list[_CameraRow]:
    file = _Bytes(path)
    rows = []
    for _ in range(file.count(24)):
        number, model, width, height = map(int, file.take("IiQQ"))
        if model not in MODELS:
            raise RecordingError(f"{path}: camera {number}: model number {model} is unknown")
        name, count = MODELS[model]
        rows.append((number, name, width, height, [float(v) for v in file.take(f"{count}d")]))
    return rows


def _text_cameras(path: Path) -> list[_CameraRow]:
    rows: list[_CameraRow] = []
    for row in read_rows(path):
        if len(row.cells) < 5:
            raise row.error("is no camera")
        number, width, height = (_whole(row.cells[i], row.where) for i in (0, 2, 3))
        rows.append((number, row.cells[1], width, height, row.numbers(4, len(row.cells))))
    return rows


def _binary_images(path: Path) -> list[ModelImage]:
    file = _Bytes(path)
    images = []
    for _ in range(file.count(64)):
        (number,) = map(int, file.take("I"))
        pose = [float(value) for value in file.take("7d")]
        (camera,) = map(int, file.take("I"))
        name = file.name()
        seen = file.array(_OBSERVATION, file.count(_OBSERVATION.itemsize))
        T = _pose(pose, f"{path}: image {name}")
        images.append(_model_image(number, name, camera, T, seen["pixel"], seen["point"]))
    return images


def _text_images(path: Path) -> list[ModelImage]:
    """Two lines an image; the second may be empty, so comments alone are left out."""
    lines = [line for line in read_text(path).splitlines() if not line.startswith("#")]
    images = []
    for number in range(0, len(lines) - len(lines) % 2, 2):
        cells = lines[number].split(maxsplit=9)
        where = f"{path}: image {number // 2 + 1}"
        if len(cells) < 10:
            raise RecordingError(f"{where} has {len(cells)} columns, 10 are needed; mend the file")
        seen = _floats(lines[number + 1].split(), where)
        if len(seen) % 3 or not np.all(np.abs(seen) < 2.0**53):
            raise RecordingError(f"{where}: its points are no triples x y id; mend the file")
        triples = np.array(seen).reshape(-1, 3)
        T = _pose(_floats(cells[1:8], where), f"{path}: image {cells[9]}")
        ids = (_whole(cells[0], where), _whole(cells[8], where))
        images.append(
            _model_image(ids[0], cells[9], ids[1], T, triples[:, :2], triples[:, 2].astype(int))
        )
    return images


def _model_image(
    number: int, name: str, camera: int, T: Mat4, pixels: F64, point: I64
) -> ModelImage:
    shows = point >= 0
    ours = np.array(pixels[shows], np.float64) - 0.5
    return ModelImage(number, name, camera, T, ours, point[shows].astype(np.int64))


def _binary_points(path: Path) -> tuple[I64, F64]:
    file = _Bytes(path)
    count = file.count(51)
    number, xyz = np.empty(count, np.int64), np.empty((count, 3))
    for i in range(count):
        number[i], *xyz[i] = file.take("Q3d")
        file.skip(11)  # colour and error
        file.skip(8 * file.count(8))  # its track
    return number, xyz


def _pose(values: list[float], where: str) -> Mat4:
    """T_world_cam of qw qx qy qz tx ty tz, which take world points to the camera."""
    q, t = np.array(values[:4]), np.array(values[4:])
    if not np.all(np.abs(values) < _MAX_POSE) or abs(float(np.linalg.norm(q)) - 1.0) > 0.01:
        raise RecordingError(f"{where}: its pose is no rigid transform; make the model anew")
    R = so3.from_quaternion_xyzw(q[None, [1, 2, 3, 0]])[0].T
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, -R @ t
    return T


def _floats(cells: list[str], where: str) -> list[float]:
    try:
        return [float(cell) for cell in cells]
    except ValueError as error:
        raise RecordingError(f"{where}: {error}; mend the file") from None


def _whole(text: str, where: str) -> int:
    if not text.isascii() or not text.isdigit():
        raise RecordingError(f"{where}: {text!r} is no number of an image, camera or point")
    return int(text)
