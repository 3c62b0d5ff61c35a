# SPDX-License-Identifier: Apache-2.0
"""Writes views whose poses and depths are known as a sequence folder."""

from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from edge.geometry import se3
from edge.geometry.camera import CameraModel
from edge.types import F64, U8


class KnownView(NamedTuple):
    """One image, where it was taken, and how far everything in it is."""

    image: U8
    T_world_cam: F64
    depth_m: F64 | None = None  # (h, w) along z; None: no depth image


def write_drive(
    folder: Path,
    camera: CameraModel,
    views: Iterable[KnownView],
    *,
    first_s: float,
    with_poses: bool = True,
) -> Path:
    """Ten images a second, with depth images where the views have depth."""
    (folder / "rgb").mkdir(parents=True)
    rgb, truth, depths = [], [], []
    for i, view in enumerate(views):
        name, t_s = f"{i:04d}.png", first_s + 0.1 * i
        cv2.imwrite(str(folder / "rgb" / name), view.image)
        rgb.append(f"{t_s:.6f} rgb/{name}")
        truth.append(" ".join(f"{v:.9f}" for v in (t_s, *se3.to_tum(view.T_world_cam))))
        if view.depth_m is not None:
            (folder / "depth").mkdir(exist_ok=True)
            millimetres = np.round(1000.0 * view.depth_m).astype(np.uint16)
            cv2.imwrite(str(folder / "depth" / name), millimetres)
            depths.append(f"{t_s:.6f} depth/{name}")
    (folder / "rgb.txt").write_text("\n".join(rgb) + "\n")
    if with_poses:
        (folder / "groundtruth.txt").write_text("\n".join(truth) + "\n")
    if depths:
        (folder / "depth.txt").write_text("\n".join(depths) + "\n")
    keys = {key: getattr(camera, key) for key in ("width", "height", "fx", "fy", "cx", "cy")}
    lines = [f"{key} = {value}" for key, value in keys.items()]
    lines += ['distortion_model = "none"', "distortion = []", "rate_hz = 10.0"]
    (folder / "camera.toml").write_text("\n".join(lines) + "\n")
    return folder
