# SPDX-License-Identifier: Apache-2.0
"""How good poses are that `mapvo-map build --poses sfm` finds, and what the whole build costs.

python -m tools.bench.structure RECORDING [--frames A:B] [--every K] [--seeds 1,2,...]

The images are taken in their order, and once more for each seed as a collection in no order.
Errors are those of the map's keyframes after the best similarity, against the recording's truth;
CPU time is that of all processes of the build.
"""

import argparse
import resource
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from edge.cameras.recording import Recording, open_recording
from edge.cli.command_line import positive, span
from edge.tiles.reader import open_map
from tools.bench.scoring import umeyama, where_measured

ANCHOR = (
    "anchors: pycolmap by hand, 60 images of redkitchen: 0.41 cm, 38 s of SIFT, exhaustive pairs "
    "and mapping; must hold on 100: 1 cm, 180 s"
)


def main() -> int:
    """Print a row for each order of the images."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("recording", type=Path)
    parser.add_argument("--frames", type=span)
    parser.add_argument("--every", type=positive, default=1)
    parser.add_argument("--seeds", default="", help="of collections in no order, as 1,2")
    arguments = parser.parse_args()
    recording = open_recording(arguments.recording, frames=arguments.frames, stride=arguments.every)
    print(f"# {where_measured()}\n# {ANCHOR}")
    print(f"{'order':<12} {'placed':>8} {'RMSE cm':>8} {'max cm':>7} {'turn deg':>8} {'CPU s':>6}")
    images = [int(i) for i in recording.indices]
    _row("as recorded", recording, images)
    for seed in filter(None, arguments.seeds.split(",")):
        shuffled = np.random.default_rng(int(seed)).permutation(images)
        _row(f"seed {seed}", recording, [int(i) for i in shuffled])
    return 0


def _row(name: str, recording: Recording, images: list[int]) -> None:
    with tempfile.TemporaryDirectory() as folder:
        collection, out = Path(folder) / "collection", Path(folder) / "map"
        _write_collection(collection, recording, images)
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        command = [sys.executable, "-m", "maps.cli", "build", str(collection), "--poses", "sfm"]
        subprocess.run([*command, "--out", str(out)], check=True, stdout=subprocess.DEVNULL)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        cpu_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
        opened = open_map(out)
        places = (np.asarray(opened.keyframe_t_ns) // 1_000_000_000).tolist()
        found = np.array(opened.T_map_cam)
    truth = recording.groundtruth
    if truth is None:
        print(f"{name:<12} {len(places):>4}/{len(images)} {'no truth':>8} {'':>16} {cpu_s:>6.0f}")
        return
    T_true = [truth.pose_at(int(recording.t_ns[images[place]])) for place in places]
    known = [i for i, T in enumerate(T_true) if T is not None]
    there = np.array([T for T in T_true if T is not None])
    S = umeyama(found[known, :3, 3], there[:, :3, 3])
    off_cm = 100.0 * np.linalg.norm(S.apply(found[known, :3, 3]) - there[:, :3, 3], axis=1)
    turned = np.einsum("ij,njk,nlk->nil", S.R, found[known, :3, :3], there[:, :3, :3])
    cosine = 0.5 * (np.trace(turned, axis1=1, axis2=2) - 1.0)
    turn_deg = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
    print(
        f"{name:<12} {len(places):>4}/{len(images)} {np.sqrt(np.mean(off_cm**2)):>8.2f} "
        f"{off_cm.max():>7.2f} {np.median(turn_deg):>8.2f} {cpu_s:>6.0f}",
        flush=True,
    )


def _write_collection(folder: Path, recording: Recording, images: list[int]) -> None:
    """A recording of these images in this order, a second apart; without poses."""
    (folder / "rgb").mkdir(parents=True)
    lines = []
    for place, image in enumerate(images):
        source = Path(str(recording.image_file(image)))
        name = f"rgb/{place:06d}{source.suffix}"
        (folder / name).symlink_to(source.resolve())
        lines.append(f"{place}.0 {name}\n")
    (folder / "rgb.txt").write_text("".join(lines))
    camera = recording.camera
    keys = ("width", "height", "fx", "fy", "cx", "cy")
    text = "".join(f"{key} = {getattr(camera, key)}\n" for key in keys)
    text += f'distortion_model = "{camera.distortion_model}"\n'
    text += f"distortion = {list(camera.distortion)}\nrate_hz = 1.0\n"
    (folder / "camera.toml").write_text(text)


if __name__ == "__main__":
    sys.exit(main())
