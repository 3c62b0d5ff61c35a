# SPDX-License-Identifier: Apache-2.0
"""EuRoC MAV recordings in the ASL layout: mav0/cam0, cam1, state_groundtruth_estimate0."""

import math
import re
from pathlib import Path

import numpy as np

from edge.cameras import groundtruth
from edge.cameras.groundtruth import GroundTruth
from edge.cameras.layout import Layout, StereoRig
from edge.cameras.tables import I64, increasing, known_rate_hz, nearest, read_rows, read_text
from edge.errors import ConfigError, RecordingError
from edge.geometry import se3
from edge.geometry.camera import CameraFile, parse_camera
from edge.types import Mat4

_TRUTH = "state_groundtruth_estimate0"
_MODELS = {"radial-tangential": "radtan", "radtan": "radtan", "equidistant": "equidistant"}
# The cameras are triggered together; what is further apart is another frame.
_MAX_PAIR_NS = 1_000_000


def is_recording(root: Path) -> bool:
    """Tell whether `root` is such a recording, or its mav0 folder."""
    return _base(root) is not None


def read(root: Path) -> Layout:
    """Layout of the recording; RecordingError says what is wrong with it."""
    base = _base(root) or root / "mav0"
    t_ns, images = _read_list(base / "cam0")
    if not images:
        raise RecordingError(
            f"{base / 'cam0' / 'data.csv'}: lists no image; the recording is empty"
        )
    file, T_body_cam = _read_sensor(base / "cam0" / "sensor.yaml")
    return Layout(
        root=root,
        camera=file.camera,
        rate_hz=known_rate_hz(file.rate_hz, t_ns, base / "cam0" / "sensor.yaml"),
        t_ns=t_ns,
        images=images,
        groundtruth=lambda: _read_groundtruth(base / _TRUTH, T_body_cam),
        right=_read_right(base / "cam1", t_ns, T_body_cam),
    )


def parse_yaml(text: str) -> dict[str, str | list[str]]:
    """Keys of a sensor.yaml: scalars and flat lists, one level of nesting as `outer.inner`.

    These files are all that is read so; a YAML library would be one more dependency on the device.
    """
    table: dict[str, str | list[str]] = {}
    text = re.sub(r"(?m)(?:^|\s)#.*$|^%.*$|^---$", "", text)
    text = re.sub(r"\[[^\]]*\]", lambda match: " ".join(match[0].split()), text)
    # Lists of a line for each item.
    text = re.sub(
        r"(?m):[ \t]*((?:\n[ \t]*-[ \t]+\S+[ \t]*)+)$",
        lambda match: f": [{', '.join(match[1].split()[1::2])}]",
        text,
    )
    outer = ""
    for indent, key, value in re.findall(
        r"(?m)^([ \t]*)([A-Za-z_]\w*)[ \t]*:[ \t]*(.*?)[ \t]*$", text
    ):
        name = f"{outer}.{key}" if indent else key
        if not indent:
            outer = key
        if value.startswith("["):
            table[name] = [cell.strip() for cell in value.strip("[]").split(",") if cell.strip()]
        elif value:
            table[name] = value.strip("\"'")
    return table


def _base(root: Path) -> Path | None:
    for base in (root / "mav0", root):
        if (base / "cam0" / "data.csv").exists() or (base / "cam0" / "sensor.yaml").exists():
            return base
    return None


def _read_list(folder: Path) -> tuple[I64, tuple[Path, ...]]:
    rows = list(read_rows(folder / "data.csv", ",", max_cells=2))
    for row in rows:
        if len(row.cells) < 2:
            raise row.error("has no file name after the time")
    t_ns = increasing([row.integer_ns() for row in rows], rows)
    return t_ns, tuple(folder / "data" / row.cells[1] for row in rows)


def _read_sensor(path: Path) -> tuple[CameraFile, Mat4]:
    """Camera and T_body_cam of a sensor.yaml."""
    table = parse_yaml(read_text(path))
    try:
        if table.get("camera_model", "pinhole") != "pinhole":
            raise ConfigError(
                f"camera_model: '{table['camera_model']}' is not read; only pinhole is"
            )
        width, height = _numbers(table, "resolution", 2)
        fx, fy, cx, cy = _numbers(table, "intrinsics", 4)
        model = table.get("distortion_model", "none")
        keys: dict[str, object] = {
            "width": width,
            "height": height,
            "fx": fx,
            "fy": fy,
            "cx": cx,
            "cy": cy,
            "distortion_model": _MODELS.get(str(model), model),
            "distortion": _numbers(table, "distortion_coefficients"),
        }
        if "rate_hz" in table:
            (keys["rate_hz"],) = _numbers(table, "rate_hz", 1)
        return parse_camera(keys), _read_pose(table)
    except ConfigError as error:
        raise RecordingError(f"{path}: {error}") from None


def _read_pose(table: dict[str, str | list[str]]) -> Mat4:
    T = np.array(_numbers(table, "T_BS.data", 16)).reshape(4, 4)
    if np.abs(T[:3, :3] @ T[:3, :3].T - np.eye(3)).max() > 1e-3:
        raise ConfigError("T_BS: is no rigid transform; copy the file anew from its origin")
    return se3.normalise(T)


def _numbers(table: dict[str, str | list[str]], key: str, count: int | None = None) -> list[float]:
    value = table.get(key, [])
    cells = [value] if isinstance(value, str) else value
    try:
        numbers = [float(cell) for cell in cells]
    except ValueError as error:
        raise ConfigError(f"{key}: {error}") from None
    if not all(map(math.isfinite, numbers)):
        raise ConfigError(f"{key}: holds a number that is not finite")
    if count is not None and len(numbers) != count:
        raise ConfigError(f"{key}: has {len(numbers)} numbers, {count} are needed")
    return numbers


def _read_right(folder: Path, t_ns: I64, T_body_left: Mat4) -> StereoRig | None:
    if not (folder / "data.csv").exists():
        return None
    right_t_ns, images = _read_list(folder)
    file, T_body_right = _read_sensor(folder / "sensor.yaml")
    pairs = nearest(t_ns, right_t_ns, _MAX_PAIR_NS)
    return StereoRig(
        file.camera,
        se3.inverse(T_body_left) @ T_body_right,
        tuple(images[j] if j >= 0 else None for j in pairs),
    )


def _read_groundtruth(folder: Path, T_body_cam: Mat4) -> GroundTruth | None:
    """Poses of the left camera: those of the body, moved by T_BS."""
    path = folder / "data.csv"
    if not path.exists():
        return None
    rows = list(read_rows(path, ","))
    t_ns = np.array([row.integer_ns() for row in rows], np.int64)
    samples = np.array([row.numbers(1, 8) for row in rows]).reshape(-1, 7)
    samples[:, 3:] = samples[:, [4, 5, 6, 3]]  # the file has qw first
    truth = groundtruth.from_samples(path, t_ns, samples)
    sensor = folder / "sensor.yaml"
    T_body_truth = _read_pose(parse_yaml(read_text(sensor))) if sensor.exists() else np.eye(4)
    return GroundTruth(truth.t_ns, truth.T_world_cam @ (se3.inverse(T_body_truth) @ T_body_cam))
