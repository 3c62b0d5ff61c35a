# SPDX-License-Identifier: Apache-2.0
"""Tiny recordings of each format, written by the tests that read them."""

from pathlib import Path

import cv2
import numpy as np

WIDTH, HEIGHT = 64, 48

CAMERA_TOML = f"""width = {WIDTH}
height = {HEIGHT}
fx = 50.0
fy = 50.0
cx = 31.5
cy = 23.5
distortion_model = "none"
distortion = []
rate_hz = 20
"""


def picture(value: int, width: int = WIDTH, height: int = HEIGHT) -> np.ndarray:
    """Grey image of a ramp that tells it from its neighbours."""
    ramp = np.add.outer(np.arange(height), np.arange(width)) + 10 * value
    return ramp.astype(np.uint8)


def write_image(path: Path, image: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), image)


def write_tum(root: Path, n: int = 6) -> Path:
    """The contract's sequence folder: n frames 50 ms apart, truth moving 1 m/s along x."""
    root.mkdir(parents=True, exist_ok=True)
    (root / "camera.toml").write_text(CAMERA_TOML)
    rows, poses = ["# time_s path"], ["# time_s tx ty tz qx qy qz qw"]
    for i in range(n):
        write_image(root / "rgb" / f"{i:03d}.png", picture(i))
        rows.append(f"{0.05 * i:.6f} rgb/{i:03d}.png")
        poses.append(f"{0.05 * i:.6f} {0.05 * i:.6f} 0 0 0 0 0 1")
    (root / "rgb.txt").write_text("\n".join(rows) + "\n")
    (root / "groundtruth.txt").write_text("\n".join(poses) + "\n")
    return root


SENSOR_YAML = """%YAML:1.0
# General sensor definitions.
sensor_type: camera
comment: VI-Sensor {name} (MT9M034)

# Sensor extrinsics wrt. the body-frame.
T_BS:
  cols: 4
  rows: 4
  data: [0.0, -1.0, 0.0, {x},
         1.0, 0.0, 0.0, 0.2,
         0.0, 0.0, 1.0, 0.3,
         0.0, 0.0, 0.0, 1.0]

# Camera specific definitions.
rate_hz: 20
resolution: [64, 48]
camera_model: pinhole
intrinsics: [50.0, 51.0, 31.5, 23.5] #fu, fv, cu, cv
distortion_model: radial-tangential
distortion_coefficients: [-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05]
"""

EUROC_T0_NS = 1403715273262142976  # 19 digits: a float64 keeps 16


def write_euroc(root: Path, n: int = 4) -> Path:
    """An ASL recording: n stereo frames 50 ms apart; the right camera misses frame 1."""
    for name, x in (("cam0", 0.0), ("cam1", 0.1)):
        folder = root / "mav0" / name
        rows = ["#timestamp [ns],filename"]
        for i in range(n):
            t_ns = EUROC_T0_NS + 50_000_000 * i
            write_image(folder / "data" / f"{t_ns}.png", picture(i + (name == "cam1")))
            if (name, i) != ("cam1", 1):
                rows.append(f"{t_ns},{t_ns}.png")
        (folder / "data.csv").write_text("\r\n".join(rows) + "\r\n")
        (folder / "sensor.yaml").write_text(SENSOR_YAML.format(name=name, x=x))
    truth = root / "mav0" / "state_groundtruth_estimate0"
    truth.mkdir()
    rows = ["#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], ..."]
    for i in range(4 * n):
        rows.append(f"{EUROC_T0_NS + 5_000_000 * i},{0.005 * i},2.0,3.0,0.6,0,0,0.8,0,0,0")
    (truth / "data.csv").write_text("\n".join(rows) + "\n")
    return root


def write_kitti(base: Path, n: int = 3, pair: tuple[int, int] = (0, 1)) -> Path:
    """A KITTI odometry sequence in base/sequences/07 with poses in base/poses/07.txt."""
    root = base / "sequences" / "07"
    for number in pair:
        for i in range(n):
            write_image(root / f"image_{number}" / f"{i:06d}.png", picture(i + number))
    (root / "times.txt").write_text("".join(f"{0.1 * i:e}\n" for i in range(n)))
    shifts = (0.0, -27.0, 3.0, -24.0)  # fx times -x of each camera: 0, 0.54, -0.06, 0.48 m
    lines = [f"P{i}: 50 0 31.5 {shift} 0 50 23.5 0 0 0 1 0" for i, shift in enumerate(shifts)]
    lines.append("Tr: 0 -1 0 0.1 0 0 -1 0.2 1 0 0 0.3")
    (root / "calib.txt").write_text("\n".join(lines) + "\n")
    (base / "poses").mkdir(exist_ok=True)
    poses = "".join(f"1 0 0 0 0 1 0 0 0 0 1 {i}\n" for i in range(n))
    (base / "poses" / "07.txt").write_text(poses)
    return root
