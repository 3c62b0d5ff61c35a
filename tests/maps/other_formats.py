# SPDX-License-Identifier: Apache-2.0
"""The posters' walk as other programs would have recorded it."""

import json
import struct
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from edge.geometry import se3, so3
from edge.types import F32, F64, U8
from tests.maps.posters import CAMERA, path, picture, posters

N = 5
COLMAP_UNIT_M = 2.5  # a unit of COLMAP's poses
_STEP_NS = 100_000_000
_T0_NS = 1403715273262142976

Frames = list[tuple[U8, F32, F64]]


def frames() -> Frames:
    """Image, depth and T_world_cam of each."""
    return [(*picture(posters(), T), T) for T in path(N)]


def _images(folder: Path, walk: Frames, names: list[str]) -> None:
    folder.mkdir(parents=True)
    for (image, _, _), name in zip(walk, names, strict=True):
        assert cv2.imwrite(str(folder / name), image)


def write_colmap(root: Path, walk: Frames) -> None:
    """With the depth maps of a dense workspace."""
    names = [f"{i:03d}.png" for i in range(N)]
    _images(root / "images", walk, names)
    sparse, maps = root / "sparse" / "0", root / "stereo" / "depth_maps"
    sparse.mkdir(parents=True)
    maps.mkdir(parents=True)
    camera = struct.pack("<IiQQ4d", 1, 1, 320, 240, 260.0, 262.0, 161.5, 119.0)
    (sparse / "cameras.bin").write_bytes(struct.pack("<Q", 1) + camera)
    data = struct.pack("<Q", N)
    for i, (_, depth, T) in enumerate(walk):
        T_cam_world = se3.inverse(T)
        x, y, z, w = so3.to_quaternion_xyzw(T_cam_world[:3, :3])
        t = T_cam_world[:3, 3] / COLMAP_UNIT_M
        data += struct.pack("<I7dI", i + 1, w, x, y, z, *t, 1) + names[i].encode() + b"\0"
        data += struct.pack("<Q", 0)
        head = f"{depth.shape[1]}&{depth.shape[0]}&1&".encode()
        units = (depth / COLMAP_UNIT_M).astype("<f4")
        (maps / f"{names[i]}.geometric.bin").write_bytes(head + units.tobytes())
    (sparse / "images.bin").write_bytes(data)
    (sparse / "points3D.bin").write_bytes(struct.pack("<Q", 0))


def write_nerfstudio(root: Path, walk: Frames) -> None:
    names = [f"frame_{i:05d}.png" for i in range(N)]
    _images(root / "images", walk, names)
    opengl = np.diag([1.0, -1.0, -1.0, 1.0])
    keys = {"w": 320, "h": 240, "fl_x": 260.0, "fl_y": 262.0, "cx": 161.5, "cy": 119.0}
    rows = [
        {"file_path": f"images/{name}", "transform_matrix": (T @ opengl).tolist()}
        for (_, _, T), name in zip(walk, names, strict=True)
    ]
    (root / "transforms.json").write_text(json.dumps({**keys, "frames": rows}))


def write_seven_scenes(root: Path, walk: Frames) -> None:
    _images(root, walk, [f"frame-{i:06d}.color.png" for i in range(N)])
    for i, (_, _, T) in enumerate(walk):
        np.savetxt(root / f"frame-{i:06d}.pose.txt", T, fmt="%.9e", delimiter="\t ")
    _write_camera(root)


def write_tum(root: Path, walk: Frames) -> None:
    """As the benchmark does, 5000 units of depth to the metre."""
    names = [f"{i}.png" for i in range(N)]
    _images(root / "rgb", walk, names)
    (root / "depth").mkdir()
    times = [f"{1305031102 + 0.1 * i:.4f}" for i in range(N)]
    rgb, depths, truth = ["# color images"], ["# file: 'rgbd_dataset.bag'"], ["# ground truth"]
    for (_, depth, T), name, t in zip(walk, names, times, strict=True):
        cv2.imwrite(str(root / "depth" / name), np.round(5000.0 * depth).astype(np.uint16))
        rgb.append(f"{t} rgb/{name}")
        depths.append(f"{t} depth/{name}")
        truth.append(f"{t} " + " ".join(f"{v:.9f}" for v in se3.to_tum(T)))
    for file, lines in (("rgb", rgb), ("depth", depths), ("groundtruth", truth)):
        (root / f"{file}.txt").write_text("\n".join(lines) + "\n")
    _write_camera(root)


def write_euroc(root: Path, walk: Frames) -> None:
    """The camera sits turned on a body, whose poses are the truth."""
    T_body_cam = se3.exp([0.1, -0.2, 0.05, 0.3, 1.2, -0.4])
    names = [f"{_T0_NS + _STEP_NS * i}.png" for i in range(N)]
    _images(root / "mav0" / "cam0" / "data", walk, names)
    rows = ["#timestamp [ns],filename"]
    truth = ["#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], ..."]
    for i, ((_, _, T), name) in enumerate(zip(walk, names, strict=True)):
        body = T @ se3.inverse(T_body_cam)
        x, y, z, w = so3.to_quaternion_xyzw(body[:3, :3])
        t_ns = _T0_NS + _STEP_NS * i
        rows.append(f"{t_ns},{name}")
        values = (*body[:3, 3], w, x, y, z)
        truth.append(f"{t_ns}," + ",".join(f"{v:.9f}" for v in values))
    (root / "mav0" / "cam0" / "data.csv").write_text("\n".join(rows) + "\n")
    data = ", ".join(f"{v:.12f}" for v in T_body_cam.ravel())
    (root / "mav0" / "cam0" / "sensor.yaml").write_text(
        f"T_BS:\n  cols: 4\n  rows: 4\n  data: [{data}]\nrate_hz: 10\nresolution: [320, 240]\n"
        "camera_model: pinhole\nintrinsics: [260.0, 262.0, 161.0, 118.5]\n"
        "distortion_model: radial-tangential\ndistortion_coefficients: [0.0, 0.0, 0.0, 0.0]\n"
    )
    folder = root / "mav0" / "state_groundtruth_estimate0"
    folder.mkdir()
    (folder / "data.csv").write_text("\n".join(truth) + "\n")


def write_kitti(root: Path, walk: Frames) -> None:
    """In sequences/07 below `root`; give that folder."""
    sequence = root / "sequences" / "07"
    _images(sequence / "image_0", walk, [f"{i:06d}.png" for i in range(N)])
    (sequence / "times.txt").write_text("".join(f"{0.1 * i:e}\n" for i in range(N)))
    (sequence / "calib.txt").write_text("P0: 260 0 161 0 0 262 118.5 0 0 0 1 0\n")
    (root / "poses").mkdir()
    rows = (" ".join(f"{v:.9e}" for v in T[:3].ravel()) for _, _, T in walk)
    (root / "poses" / "07.txt").write_text("\n".join(rows) + "\n")


WRITERS: dict[str, tuple[Callable[[Path, Frames], None], str]] = {
    "colmap": (write_colmap, ""),
    "nerfstudio": (write_nerfstudio, ""),
    "seven_scenes": (write_seven_scenes, ""),
    "tum": (write_tum, ""),
    "euroc": (write_euroc, ""),
    "kitti": (write_kitti, "sequences/07"),
}


def _write_camera(root: Path) -> None:
    keys = {key: getattr(CAMERA, key) for key in ("width", "height", "fx", "fy", "cx", "cy")}
    lines = [f"{key} = {value}" for key, value in keys.items()]
    (root / "camera.toml").write_text("\n".join([*lines, "rate_hz = 10.0"]) + "\n")
