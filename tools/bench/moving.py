# SPDX-License-Identifier: Apache-2.0
"""What something large that moves through the view does to the odometry, with masks and without.

`python -m tools.bench.moving --drive DIR --out FOLDER`: a textured red board walks through the
images of a recording with poses, again and again, a third of the image wide; the model of key
colours finds it. Errors after alignment of the whole odometry (Sim(3)), lower is better; without a
board, both must be the same.
"""

import argparse
import shutil
from pathlib import Path

import cv2
import msgspec
import numpy as np
import onnx

from edge.cameras.recording import open_recording
from edge.config import Config
from edge.geometry.camera import CameraModel
from edge.runtime.kernel_cache import use_kernel_cache
from edge.runtime.replay import ReplayJob, replay
from edge.types import U8
from tools.bench.scoring import score
from tools.key_colour_model import make_model
from tools.simworld.objects import KEY_COLOURS

_AHEAD_M, _SIZE_M = 1.3, (0.8, 1.4)
_REACH_M = 1.5  # to the left and right, where it turns
_SPEED_M_S = 0.6
_CLASS = "ball"
_TEXTURE_PX = (200, 350)


def main() -> None:
    """Run and print the table."""
    parser = argparse.ArgumentParser(description="Odometry beside something that moves.")
    parser.add_argument("--drive", type=Path, required=True, help="recording with poses")
    parser.add_argument("--out", type=Path, required=True, help="folder for recordings and runs")
    options = parser.parse_args()
    use_kernel_cache()
    options.out.mkdir(parents=True, exist_ok=True)
    model = options.out / "key_colours.onnx"
    onnx.save(make_model(), model)
    drives = {"as it is": options.drive, "with a board": options.out / "board"}
    _write_board_drive(options.drive, drives["with a board"])
    print(f"{'':14} {'masks':>6} {'rmse cm':>8} {'tracked':>8} {'starts':>7}")
    for name, drive in drives.items():
        for masks in (False, True):
            run = options.out / f"run-{name.replace(' ', '-')}-{masks}"
            print(_row(name, drive, model, run, masks=masks))


def _row(name: str, drive: Path, model: Path, run: Path, *, masks: bool) -> str:
    config = Config()
    if masks:
        segmenter = msgspec.structs.replace(config.segmenter, model=str(model), moving=(_CLASS,))
        config = msgspec.structs.replace(config, segmenter=segmenter)
    stats, _ = replay(ReplayJob(drive, run, None, None), config)
    truth = open_recording(drive).groundtruth
    assert truth is not None
    rows = np.loadtxt(run / "odometry.tum", ndmin=2)
    t_ns = np.rint(1e9 * rows[:, 0]).astype(np.int64)
    found = score(t_ns, rows[:, 1:4], truth.t_ns, truth.T_world_cam[:, :3, 3])
    assert found is not None
    starts = len(list(run.glob("odometry*.tum")))
    return (
        f"{name:14} {masks!s:>6} {100.0 * found.rmse_m:8.1f} "
        f"{stats['tracked']}/{stats['frames']:<4} {starts:7d}"
    )


def _write_board_drive(drive: Path, out: Path) -> None:
    """The recording with the board in its images, before everything else."""
    if (out / "rgb.txt").exists():
        return
    recording = open_recording(drive)
    (out / "rgb").mkdir(parents=True)
    for name in ("camera.toml", "groundtruth.txt"):
        shutil.copy(drive / name, out / name)
    texture = _texture()
    lines = []
    for index in recording.indices.tolist():
        image = recording.colour(index)
        assert image is not None
        t_s = 1e-9 * int(recording.t_ns[index])
        _draw(image[:, :, ::-1], texture, recording.camera, t_s, out / "rgb" / f"{index:06d}.png")
        lines.append(f"{t_s:.9f} rgb/{index:06d}.png")
    (out / "rgb.txt").write_text("\n".join(lines) + "\n")


def _texture() -> U8:
    """Red in blotches of several sizes (h, w, 3), blue first."""
    rng = np.random.default_rng(3)
    w, h = _TEXTURE_PX
    light = np.full((h, w), 0.85, np.float32)
    for cell in (6, 15, 40):
        noise = rng.normal(0.0, 0.1, (h // cell + 2, w // cell + 2)).astype(np.float32)
        light += cv2.resize(noise, (w, h), interpolation=cv2.INTER_NEAREST)
    colour = np.clip(light, 0.7, 1.0)[:, :, None] * np.array(KEY_COLOURS[_CLASS])
    return np.clip(colour, 0, 255).astype(np.uint8)


def _draw(bgr: U8, texture: U8, camera: CameraModel, t_s: float, path: Path) -> None:
    """Write the image with the board where it is at that time, upright before the camera."""
    period = 4.0 * _REACH_M / _SPEED_M_S
    phase = (t_s / period) % 1.0
    x = _REACH_M * (4.0 * abs(phase - 0.5) - 1.0)
    half = 0.5 * np.array(_SIZE_M)
    y = 0.15 * np.sin(3.0 * t_s)  # its walk
    corners = np.array(
        [[x - half[0], y - half[1]], [x + half[0], y - half[1]],
         [x + half[0], y + half[1]], [x - half[0], y + half[1]]]
    )  # fmt: skip
    at = camera.project(np.column_stack((corners, np.full(4, _AHEAD_M)))).astype(np.float32)
    h, w = texture.shape[:2]
    own = np.array([[0, 0], [w, 0], [w, h], [0, h]], np.float32)
    H = cv2.getPerspectiveTransform(own, at)
    size = (bgr.shape[1], bgr.shape[0])
    over = cv2.warpPerspective(texture, H, size, flags=cv2.INTER_AREA)
    there = cv2.warpPerspective(np.full((h, w), 255, np.uint8), H, size) > 127
    cv2.imwrite(str(path), np.where(there[:, :, None], over, bgr))


if __name__ == "__main__":
    main()
