# SPDX-License-Identifier: Apache-2.0
"""Collections of posed images as other programs write them: COLMAP, nerfstudio, 7-Scenes."""

import json
import struct
from pathlib import Path

import numpy as np

from edge.geometry import se3, so3
from edge.types import F64
from tests.edge.cameras.recordings import HEIGHT, WIDTH, picture, write_image

Cameras = dict[int, tuple[int, str, list[float]]]  # id: model number, name, parameters
PINHOLE: Cameras = {1: (1, "PINHOLE", [50.0, 51.0, 32.0, 24.0])}
POINTS = {7: (1.0, 2.0, 5.0), 3: (0.5, -1.0, 4.0)}
# Of each image: x, y (centres at halves) and the point that it shows, or none.
OBSERVATIONS = [(10.5, 20.5, 7), (11.0, 21.0, -1), (40.25, 8.5, 3)]


def pose(i: int) -> F64:
    """T_world_cam of image i: all six numbers tell it from others."""
    return se3.exp([0.1 * i, 0.02, -0.03 * i, 0.01 * i, 0.2, -0.05])


def names(n: int) -> list[str]:
    return [f"left/{i:03d}.png" for i in range(n)]


def write_images(folder: Path, n: int) -> None:
    for i, name in enumerate(names(n)):
        write_image(folder / name, picture(i))


def write_colmap(
    root: Path, n: int = 3, *, binary: bool = True, cameras: Cameras = PINHOLE, model: str = "0"
) -> Path:
    """A workspace of n images, which take the cameras in turn; written in reverse order."""
    write_images(root / "images", n)
    folder = root / "sparse" / model
    folder.mkdir(parents=True, exist_ok=True)
    rows = []
    for i in reversed(range(n)):
        T = se3.inverse(pose(i))
        x, y, z, w = so3.to_quaternion_xyzw(T[:3, :3])
        rows.append((30 - i, (w, x, y, z, *T[:3, 3]), sorted(cameras)[i % len(cameras)], i))
    (write_binary if binary else write_text)(folder, cameras, rows)
    return root


def write_binary(folder: Path, cameras: Cameras, rows: list) -> None:
    data = struct.pack("<Q", len(cameras))
    for number, (model, _, parameters) in cameras.items():
        data += struct.pack("<IiQQ", number, model, WIDTH, HEIGHT)
        data += struct.pack(f"<{len(parameters)}d", *parameters)
    (folder / "cameras.bin").write_bytes(data)
    data = struct.pack("<Q", len(rows))
    for number, values, camera, i in rows:
        data += struct.pack("<I7dI", number, *values, camera) + names(i + 1)[i].encode() + b"\0"
        data += struct.pack("<Q", len(OBSERVATIONS))
        data += b"".join(struct.pack("<ddq", *seen) for seen in OBSERVATIONS)
    (folder / "images.bin").write_bytes(data)
    data = struct.pack("<Q", len(POINTS))
    for number, xyz in POINTS.items():
        data += struct.pack("<Q3d3BdQ", number, *xyz, 1, 2, 3, 0.5, len(rows))
        data += b"".join(struct.pack("<II", row[0], 0) for row in rows)
    (folder / "points3D.bin").write_bytes(data)


def write_text(folder: Path, cameras: Cameras, rows: list) -> None:
    lines = ["# Camera list"]
    for number, (_, model, parameters) in cameras.items():
        lines.append(f"{number} {model} {WIDTH} {HEIGHT} {' '.join(map(repr, parameters))}")
    (folder / "cameras.txt").write_text("\n".join(lines) + "\n")
    lines = ["# Image list", "# two lines each"]
    for number, values, camera, i in rows:
        lines.append(f"{number} {' '.join(f'{v:.17g}' for v in values)} {camera} {names(i + 1)[i]}")
        lines.append(" ".join(f"{x} {y} {point}" for x, y, point in OBSERVATIONS))
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    lines = [f"{k} {x} {y} {z} 1 2 3 0.5 10 0 11 0" for k, (x, y, z) in POINTS.items()]
    (folder / "points3D.txt").write_text("\n".join(lines) + "\n")


def write_depth_map(path: Path, depth: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    height, width = depth.shape
    path.write_bytes(f"{width}&{height}&1&".encode() + depth.astype("<f4").tobytes())


def write_nerfstudio(root: Path, n: int = 3, *, frames: list | None = None, **keys: object) -> Path:
    """A folder of n images and transforms.json; `frames` adds keys to each frame."""
    write_images(root, n)
    opengl = np.diag([1.0, -1.0, -1.0, 1.0])
    table = {"camera_model": "OPENCV", "w": WIDTH, "h": HEIGHT, "fl_x": 50.0, "fl_y": 51.0}
    rows: list[dict] = [
        {"file_path": name, "transform_matrix": (pose(i) @ opengl).tolist()}
        for i, name in enumerate(names(n))
    ]
    for row, more in zip(rows, frames or [], strict=False):
        row.update(more)
    table |= {"cx": 32.0, "cy": 24.0, "frames": rows[::-1]} | keys
    (root / "transforms.json").write_text(json.dumps(table))
    return root


def write_seven_scenes(root: Path, n: int = 3) -> Path:
    """A sequence of n images from frame 5 on; frame 6 has no pose."""
    for i in range(n):
        stem = f"frame-{5 + i:06d}"
        write_image(root / f"{stem}.color.png", picture(i, 640, 480))
        if i != 1:
            rows = "".join("\t ".join(f"{v:.9e}" for v in row) + "\t \n" for row in pose(i))
            (root / f"{stem}.pose.txt").write_text(rows)
    return root
