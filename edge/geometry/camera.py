# SPDX-License-Identifier: Apache-2.0
"""A calibrated camera: pixels of its raw image against those of an ideal pinhole."""

import math
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from edge.errors import ConfigError
from edge.geometry import distortion, so3
from edge.types import F32, F64, U8, Mat4, Pinhole

_NUMBER_KEYS = ("width", "height", "fx", "fy", "cx", "cy")
_KEYS = (
    *_NUMBER_KEYS,
    *("distortion_model", "distortion", "rate_hz", "T_left_right", "identity"),
)
_MAX_SIDE_PX = 16384  # larger than any sensor; a slipped digit is caught here
_MAX_RATE_HZ = 10_000.0


@dataclass(frozen=True, slots=True)
class CameraModel:
    """Size, intrinsics [px] and lens of one camera; pixel centres lie on integers.

    `distortion_model` is none, radtan (k1 k2 p1 p2 [k3 [k4 k5 k6]], OpenCV's order) or
    equidistant (k1 k2 k3 k4). The ideal camera has the same K and no distortion.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion_model: str = distortion.NONE
    distortion: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        _check_size(self)
        _check_intrinsics(self)
        _check_distortion(self)

    @property
    def pinhole(self) -> Pinhole:
        """The ideal camera of the same K and size."""
        return Pinhole(self.width, self.height, self.fx, self.fy, self.cx, self.cy)

    @property
    def field_limit(self) -> float:
        """Ideal radius on the normalised plane beyond which the lens model folds back."""
        return distortion.field_limit(self.distortion_model, self.distortion)

    def normalise(self, pixels: F64) -> F64:
        """Points (n, 2) on the normalised plane of pixels (n, 2): K^-1, without the lens."""
        return (np.asarray(pixels, np.float64) - (self.cx, self.cy)) / (self.fx, self.fy)

    def denormalise(self, points: F64) -> F64:
        """Pixels (n, 2) of points (n, 2) on the normalised plane: K, without the lens."""
        return np.asarray(points, np.float64) * (self.fx, self.fy) + (self.cx, self.cy)

    def distort(self, normalised: F64) -> F64:
        """Where the lens puts ideal points: (n, 2) to (n, 2), both on the normalised plane."""
        points = np.asarray(normalised, np.float64)
        return distortion.distort(self.distortion_model, self.distortion, points)

    def undistort(self, normalised: F64) -> F64:
        """Inverse of `distort`; nan where the model has none."""
        points = np.asarray(normalised, np.float64)
        return distortion.undistort(self.distortion_model, self.distortion, points)

    def distort_pixels(self, pixels: F64) -> F64:
        """Raw pixels (n, 2) float64 of ideal pixels (n, 2)."""
        return self.denormalise(self.distort(self.normalise(pixels)))

    def undistort_pixels(self, pixels: F64 | F32) -> F64:
        """Ideal pixels (n, 2) float64 of raw pixels (n, 2); nan where the model has no inverse."""
        if self.distortion_model == distortion.NONE:
            return np.array(pixels, np.float64)
        return self.denormalise(self.undistort(self.normalise(np.asarray(pixels, np.float64))))

    def project(self, points: F64) -> F64:
        """Raw pixels (n, 2) of points (n, 3) in the camera frame; nan where the lens sees none."""
        with np.errstate(divide="ignore", invalid="ignore"):
            ideal = points[:, :2] / points[:, 2:]
            seen = (points[:, 2] > 0.0) & (np.hypot(*ideal.T) <= self.field_limit)
        ideal[~seen] = np.nan
        return self.denormalise(self.distort(ideal))

    def undistortion_maps(
        self,
        pinhole: Pinhole | None = None,
        radial: float = 0.0,
    ) -> tuple[F32, F32, U8]:
        """Where each pixel of an ideal image lies in the raw image.

        The ideal image is that of `pinhole` (default: `self.pinhole`). `radial` k puts one more
        bend, r (1 + k r^2), before the lens model: what the calibration missed.

        Returns
        -------
        map_x, map_y : (h, w) float32, raw pixels, as cv2.remap takes them; -1 where the lens
            model gives none
        valid : (h, w) uint8, 1 where the source and one pixel around it lie in the raw image
        """
        ideal = pinhole or self.pinhole
        v, u = np.mgrid[: ideal.height, : ideal.width].reshape(2, -1)
        x, y = (u - ideal.cx) / ideal.fx, (v - ideal.cy) / ideal.fy
        bend = 1.0 + radial * (x * x + y * y)
        rays = np.stack((x * bend, y * bend, np.ones_like(x)), axis=1)
        raw = self.project(rays)
        with np.errstate(invalid="ignore"):
            inside = (raw >= 1.0) & (raw <= (self.width - 2.0, self.height - 2.0))
        shape = (ideal.height, ideal.width)
        map_x, map_y = np.nan_to_num(raw, nan=-1.0).astype(np.float32).T
        valid = inside.all(axis=1).astype(np.uint8)
        return (
            np.ascontiguousarray(map_x).reshape(shape),
            np.ascontiguousarray(map_y).reshape(shape),
            valid.reshape(shape),
        )


class CameraFile(NamedTuple):
    """What a camera.toml says."""

    camera: CameraModel
    rate_hz: float | None
    T_left_right: Mat4 | None  # in camera_right.toml only
    identity: str = ""  # the one camera that this holds for; empty: not said


def load_camera(path: str | Path) -> CameraModel:
    """Camera model of a camera.toml; ConfigError names the file and the key."""
    return load_camera_file(path).camera


def load_camera_file(path: str | Path) -> CameraFile:
    """All that a camera.toml or camera_right.toml says; ConfigError names the file and the key."""
    try:
        table = tomllib.loads(Path(path).read_text(encoding="utf-8"))
    except FileNotFoundError:
        message = f"{path}: no such file; name one that `mapvo calibrate` wrote"
        raise ConfigError(message) from None
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from None
    except UnicodeDecodeError:
        raise ConfigError(f"{path}: is no UTF-8 text; name a camera.toml") from None
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise ConfigError(f"{path}: is not TOML: {error}") from None
    try:
        return parse_camera(table)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None


def parse_camera(table: Mapping[str, object]) -> CameraFile:
    """Camera of the keys of a camera.toml; ConfigError names the key."""
    if unknown := sorted(set(table) - set(_KEYS)):
        raise ConfigError(f"unknown key '{unknown[0]}'; known are {', '.join(_KEYS)}")
    if missing := [key for key in _NUMBER_KEYS if key not in table]:
        raise ConfigError(f"key '{missing[0]}' is missing; add it")
    model = table.get("distortion_model", distortion.NONE)
    if not isinstance(model, str):
        raise ConfigError("distortion_model: must be a string")
    camera = CameraModel(
        width=_whole(table, "width"),
        height=_whole(table, "height"),
        fx=_number(table, "fx"),
        fy=_number(table, "fy"),
        cx=_number(table, "cx"),
        cy=_number(table, "cy"),
        distortion_model=model,
        distortion=tuple(_numbers(table.get("distortion", []), "distortion")),
    )
    rate_hz = _number(table, "rate_hz") if "rate_hz" in table else None
    if rate_hz is not None and not 0.0 < rate_hz <= _MAX_RATE_HZ:
        raise ConfigError(f"rate_hz: {rate_hz:g} is impossible; give frames per second")
    T = _transform(table["T_left_right"]) if "T_left_right" in table else None
    identity = table.get("identity", "")
    if not isinstance(identity, str):
        raise ConfigError("identity: must be a string, as `mapvo calibrate` writes it")
    return CameraFile(camera, rate_hz, T, identity)


def _check_size(camera: CameraModel) -> None:
    for key, value in (("width", camera.width), ("height", camera.height)):
        if not 16 <= value <= _MAX_SIDE_PX:
            raise ConfigError(f"{key}: {value} is impossible; give pixels, 16 to {_MAX_SIDE_PX}")


def _check_intrinsics(camera: CameraModel) -> None:
    for key, value in (("fx", camera.fx), ("fy", camera.fy)):
        if not 1.0 <= value <= 100.0 * camera.width:
            raise ConfigError(f"{key}: {value:g} is impossible; give the focal length in pixels")
    for key, value, side in (("cx", camera.cx, camera.width), ("cy", camera.cy, camera.height)):
        if not -0.5 <= value <= side - 0.5:
            raise ConfigError(f"{key}: {value:g} lies outside the image; give pixels")


def _check_distortion(camera: CameraModel) -> None:
    model, coefficients = camera.distortion_model, camera.distortion
    counts = distortion.COEFFICIENT_COUNTS.get(model)
    if counts is None:
        known = ", ".join(distortion.COEFFICIENT_COUNTS)
        raise ConfigError(f"distortion_model: '{model}' is unknown; known are {known}")
    if len(coefficients) not in counts:
        expected = " or ".join(map(str, counts))
        message = f"distortion: {len(coefficients)} coefficients; {model} takes {expected}"
        raise ConfigError(message)
    if not all(abs(k) < 1e4 for k in coefficients):
        raise ConfigError("distortion: a coefficient is above 10000; calibrate anew")


def _number(table: Mapping[str, object], key: str) -> float:
    (value,) = _numbers([table[key]], key)
    return value


def _numbers(values: object, key: str) -> list[float]:
    if not isinstance(values, list):
        raise ConfigError(f"{key}: must be a list of numbers")
    for value in values:
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise ConfigError(f"{key}: {value!r} is no number")
        if not math.isfinite(value):
            raise ConfigError(f"{key}: {value} is not finite")
    return [float(value) for value in values]


def _whole(table: Mapping[str, object], key: str) -> int:
    value = _number(table, key)
    if value != int(value):
        raise ConfigError(f"{key}: {value:g} must be a whole number of pixels")
    return int(value)


def _transform(rows: object) -> Mat4:
    key = "T_left_right"
    if not isinstance(rows, list) or len(rows) != 4:
        raise ConfigError(f"{key}: must have 4 rows of 4 numbers")
    T = [_numbers(row, key) for row in rows]
    if any(len(row) != 4 for row in T):
        raise ConfigError(f"{key}: must have 4 rows of 4 numbers")
    matrix = np.array(T, np.float64)
    R = matrix[:3, :3]
    rigid = np.allclose(R @ R.T, np.eye(3), atol=1e-3) and np.linalg.det(R) > 0.0
    if not (rigid and np.array_equal(matrix[3], [0, 0, 0, 1])):
        raise ConfigError(f"{key}: is no rigid transform; give the right camera's pose in the left")
    matrix[:3, :3] = so3.normalise(R)
    return matrix
