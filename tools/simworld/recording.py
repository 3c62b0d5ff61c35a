# SPDX-License-Identifier: Apache-2.0
"""A drive through a world, written as a recording in the sequence layout."""

import json
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, field
from pathlib import Path as FilePath

import cv2
import numpy as np

from edge.geometry import se3
from edge.geometry.camera import CameraModel
from edge.types import F64
from tools.simworld.paths import Path, seconds_of
from tools.simworld.renderer import Renderer
from tools.simworld.sensor import Capture, Sensor, capture
from tools.simworld.world import World

JPEG_QUALITY = 95
Progress = Callable[[int, int], None]  # done, of how many


@dataclass(frozen=True, slots=True)
class Recipe:
    """What of a path is written, and how."""

    every: int = 1  # each k-th frame alone
    depth: bool = False
    ids: bool = False
    image_format: str = "jpg"  # or png
    workers: int = 1  # threads; the kernels release the lock
    sensor: Sensor = field(default_factory=Sensor)
    about: dict[str, object] = field(default_factory=dict)  # further keys of info.json


def write_recording(
    folder: FilePath,
    renderer: Renderer,
    path: Path,
    recipe: Recipe | None = None,
    progress: Progress | None = None,
) -> None:
    """Render a path and write rgb, camera, ground truth and what else the recipe asks for."""
    recipe = recipe or Recipe()
    chosen = list(range(0, len(path.t_ns), recipe.every))
    folders = ["rgb"] + recipe.depth * ["depth"] + recipe.ids * ["ids"]
    for name in folders:
        (folder / name).mkdir(parents=True, exist_ok=True)

    def work(index: int) -> None:
        _write_frame(folder, index, capture(renderer, path, index, recipe.sensor), recipe)

    with ThreadPoolExecutor(max(1, recipe.workers)) as pool:
        for done, _ in enumerate(pool.map(work, chosen), start=1):
            if progress is not None:
                progress(done, len(chosen))
    write_tables(folder, path, chosen, recipe)
    write_camera(folder / "camera.toml", renderer.camera, _rate_hz(path))
    write_info(folder / "info.json", renderer.world, recipe)


def _write_frame(folder: FilePath, index: int, frame: Capture, recipe: Recipe) -> None:
    name = f"{index:06d}"
    flags = [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY] if recipe.image_format == "jpg" else []
    _write_image(folder / "rgb" / f"{name}.{recipe.image_format}", frame.bgr, flags)
    if recipe.depth:
        millimetres = np.clip(np.rint(1000.0 * frame.depth_m), 0, 65535).astype(np.uint16)
        _write_image(folder / "depth" / f"{name}.png", millimetres, [])
    if recipe.ids:
        _write_image(folder / "ids" / f"{name}.png", frame.ids.astype(np.uint16), [])


def _write_image(
    file: FilePath, image: np.ndarray[tuple[int, ...], np.dtype[np.generic]], flags: Sequence[int]
) -> None:
    ok, data = cv2.imencode(file.suffix, image, list(flags))
    if not ok:
        raise OSError(f"cannot encode {file}")
    file.write_bytes(data.tobytes())


def seconds(t_ns: int) -> str:
    """Nanoseconds as a decimal number of seconds, exactly."""
    return f"{t_ns // 10**9}.{t_ns % 10**9:09d}"


def write_tables(folder: FilePath, path: Path, chosen: Sequence[int], recipe: Recipe) -> None:
    """Write rgb.txt, depth.txt and groundtruth.txt."""
    names = {"rgb": recipe.image_format}
    if recipe.depth:
        names["depth"] = "png"
    for name, suffix in names.items():
        rows = [f"{seconds(int(path.t_ns[i]))} {name}/{i:06d}.{suffix}" for i in chosen]
        (folder / f"{name}.txt").write_text("\n".join(["# time_s path", *rows, ""]))
    rows = [
        seconds(int(path.t_ns[i])) + "".join(f" {x:.9f}" for x in se3.to_tum(T))
        for i, T in zip(chosen, _poses(path, chosen), strict=True)
    ]
    head = "# time_s tx ty tz qx qy qz qw  camera-to-world (T_world_cam), metres; exact"
    (folder / "groundtruth.txt").write_text("\n".join([head, *rows, ""]))


def _poses(path: Path, chosen: Sequence[int]) -> F64:
    return path.at(seconds_of(path.t_ns[list(chosen)]))


def _rate_hz(path: Path) -> float:
    return 1e9 / float(path.t_ns[1] - path.t_ns[0]) if len(path.t_ns) > 1 else 1.0


def write_camera(file: FilePath, camera: CameraModel, rate_hz: float) -> None:
    """Write the calibration as TOML."""
    lines = [f"{key} = {getattr(camera, key)}" for key in ("width", "height")]
    lines += [f"{key} = {float(getattr(camera, key))!r}" for key in ("fx", "fy", "cx", "cy")]
    lines.append(f'distortion_model = "{camera.distortion_model}"')
    lines.append(f"distortion = {[float(d) for d in camera.distortion]}")
    lines.append(f"rate_hz = {round(rate_hz, 6)}")
    file.write_text("\n".join([*lines, ""]))


def write_info(file: FilePath, world: World, recipe: Recipe) -> None:
    """Write what the world holds: names and labels by instance id."""
    info = {
        "style": world.style,
        "seed": world.seed,
        "sensor": asdict(recipe.sensor),
        "changes": [],
        **recipe.about,
        "objects": {str(t.id): [t.name, t.label] for t in world.things},
    }
    file.write_text(json.dumps(info, indent=1) + "\n")
