# SPDX-License-Identifier: Apache-2.0
"""Makes the tiny map that ships with `edge/runtime` for warming up.

Run it again when the map format or the features change: a test says when.
"""

import shutil
import sys
import tempfile
from pathlib import Path

import cv2
import numpy as np

from edge.config.features import OrbConfig
from edge.outputs import rows
from edge.runtime.synthetic import CAMERA, RATE_HZ, WallDrive
from edge.runtime.warm_up import DRIVE_FRAMES, MAP_FOLDER
from maps.build import BuildInput, build
from maps.settings import BuildSettings

EVERY = 12
MAX_FEATURES = 150


def write_recording(folder: Path, drive: WallDrive, indices: range) -> None:
    """Write the frames `indices` of `drive` with pose and depth in the sequence layout."""
    (folder / "rgb").mkdir(parents=True)
    (folder / "depth").mkdir()
    frames = {frame.index: frame for frame in drive}
    lines: dict[str, list[str]] = {"rgb.txt": [], "depth.txt": [], "groundtruth.txt": []}
    for index in indices:
        frame = frames[index]
        cv2.imwrite(str(folder / f"rgb/{index}.png"), frame.image)
        depth_mm = np.rint(1000.0 * drive.depth(index)).astype(np.uint16)
        cv2.imwrite(str(folder / f"depth/{index}.png"), depth_mm)
        lines["rgb.txt"].append(f"{frame.t_ns * 1e-9:.9f} rgb/{index}.png\n")
        lines["depth.txt"].append(f"{frame.t_ns * 1e-9:.9f} depth/{index}.png\n")
        lines["groundtruth.txt"].append(rows.tum(frame.t_ns, drive.pose(index)))
    for name, text in lines.items():
        (folder / name).write_text("".join(text))
    (folder / "camera.toml").write_text(
        f"width = {CAMERA.width}\nheight = {CAMERA.height}\n"
        f"fx = {CAMERA.fx}\nfy = {CAMERA.fy}\ncx = {CAMERA.cx}\ncy = {CAMERA.cy}\n"
        f'distortion_model = "none"\ndistortion = []\nrate_hz = {RATE_HZ}\n'
    )


def main() -> int:
    """Replace the map in the package."""
    with tempfile.TemporaryDirectory() as name:
        recording = Path(name) / "wall"
        write_recording(recording, WallDrive(DRIVE_FRAMES), range(0, DRIVE_FRAMES, EVERY))
        settings = BuildSettings(max_stored_features=MAX_FEATURES)
        extractor = OrbConfig(max_features=2 * MAX_FEATURES)
        report = build(BuildInput([recording]), Path(name) / "map", settings, extractor)
        shutil.rmtree(MAP_FOLDER, ignore_errors=True)
        shutil.copytree(Path(name) / "map", MAP_FOLDER)
    size = sum(file.stat().st_size for file in MAP_FOLDER.rglob("*") if file.is_file())
    print(f"{MAP_FOLDER}: {report.manifest.counts.keyframes} keyframes, {size / 1e3:.0f} kB")
    return 0


if __name__ == "__main__":
    sys.exit(main())
