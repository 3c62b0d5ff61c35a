# SPDX-License-Identifier: Apache-2.0
"""How good the depths are that a map's images give by themselves (`--depth multiview`).

python -m tools.bench.maps_depth [--data DIR] [--only NAME ...] [--picture FILE.png]

Given poses, every pixel that the odometry could choose. Errors are against given depth, where its
3x3 pixels lie together. Where there is none, patches are looked up by their depth in images that
the map was not built from: the share that looks the same (correlation over 0.7), and that share
with depths that are 5 % wrong. `seen %`: the error where the images themselves agree with the
given depth (mean correlation over 0.85 in the neighbours), and the share of such pixels. Few are
at the lamps of icl, half of its pixels: its depth is that of their flat covers, the images show the
grids behind, and look much less alike by the given depth there than by ours. A `*` marks a missed
bound: 2 % median error, 60 % of the pixels, 0.5 s of CPU an image.
"""

import argparse
import tempfile
import time
from functools import partial
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from edge.cameras.recording import Recording, open_recording
from edge.config.features import OrbConfig
from edge.geometry import se3
from edge.geometry.camera import CameraModel
from edge.types import F32, F64, U8, Bools
from maps.depth import kernels_multiview
from maps.depth.multiview import Depths
from maps.depth.sweep import derotated, fine_image
from maps.lens_build import Measured
from maps.settings import BuildSettings
from maps.survey import Survey
from maps.views import choose_views
from maps.work_folder import WorkFolder
from maps.workers import open_workers
from tools.bench.scoring import where_measured

# Name, each K-th image, and whether an image so many frames on is held out.
CASES = {"office/map": (1, 0), "icl_office_kt0": (5, 0), "redkitchen": (5, 12)}
SETTINGS = BuildSettings(depth="none", lens="given")
MAX_ERROR, MIN_SHARE, MAX_CPU_S = 0.02, 0.60, 0.5
WRONG = 1.05
HEADER = (
    f"{'recording':16s} {'images':>6s} {'pixels':>7s} {'known %':>8s} {'error %':>8s} "
    f"{'seen % (of)':>12s} {'over 5 %':>8s} {'CPU ms':>7s}   "
    "held-out: same %, same % with depths 5 % wrong"
)


class Scored(NamedTuple):
    """One image."""

    pixels: int
    known: float
    error: F64  # relative, of pixels with a true depth
    seen: Bools  # whether the images agree with that
    same: tuple[float, float] | None  # of held-out patches


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description="depths of images against given ones")
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--only", nargs="+", default=list(CASES), metavar="NAME")
    parser.add_argument("--picture", type=Path, metavar="FILE.png", help="of one image of each")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    print(where_measured())
    print(HEADER)
    pictures = []
    for name in arguments.only:
        text, picture = measure(arguments.data / name, name)
        print(text, flush=True)
        pictures.append(picture)
    print("anchors: plane sweep 320x240, 4 neighbours: 71 % at 2.3 %, 620 ms an image; rectified")
    print("SGBM, one neighbour: 52 % at 2.8 %, 70 ms")
    if arguments.picture:
        cv2.imwrite(str(arguments.picture), np.vstack(pictures))


def measure(root: Path, name: str) -> tuple[str, F32]:
    """One line of the table, and a picture of an image in the middle."""
    every, ahead = CASES[name]
    recording = open_recording(root)
    chosen = choose_views([root], None, every, frozenset())
    with open_workers(1) as workers, tempfile.TemporaryDirectory() as scratch:
        survey = Survey(OrbConfig(), workers, WorkFolder(Path(scratch)))
        measured = survey.measure(chosen, survey.describe(chosen, SETTINGS), SETTINGS)
        depths = Depths(chosen, measured.descriptions, measured.points, survey.work)
        spent = []
        for number in depths.numbers:
            began = time.process_time()
            depths.swept(number)
            spent.append(time.process_time() - began)
        scored = [score(recording, measured, depths, number, ahead) for number in depths.numbers]
        picture = draw(recording, measured, depths, depths.numbers[len(depths.numbers) // 2])
    error = np.concatenate([each.error for each in scored])
    known = float(np.mean([each.known for each in scored]))
    cpu_s = float(np.median(spent[1:]))
    median = f"{100 * np.median(error):8.2f}" if len(error) else f"{'-':>8s}"
    seen = np.concatenate([each.seen for each in scored])
    fair = f"{'-':>12s}"
    if len(error):
        fair = f"{100 * np.median(error[seen]):7.2f} ({100 * seen.mean():2.0f})"
    over = f"{100 * np.mean(error > 0.05):8.1f}" if len(error) else f"{'-':>8s}"
    same = [each.same for each in scored if each.same is not None]
    held = " ".join(f"{100 * value:6.1f}" for value in np.mean(same, axis=0)) if same else ""
    missed = len(error) > 0 and np.median(error) > MAX_ERROR
    return (
        f"{name:16s} {len(scored):6d} {np.mean([each.pixels for each in scored]):7.0f} "
        f"{100 * known:7.1f}{'*' if known < MIN_SHARE else ' '} {median}{'*' if missed else ' '}"
        f"{fair} {over} {1e3 * cpu_s:6.0f}{'*' if cpu_s > MAX_CPU_S else ' '}  {held}"
    ), picture


def score(
    recording: Recording, measured: Measured, depths: Depths, number: int, ahead: int
) -> Scored:
    """Compare one image's depths."""
    swept, known = depths.swept(number), depths.agreed(number)
    strong = len(swept.rho) - len(measured.descriptions[number].features.pixels)
    pixels, rho, known = swept.pixels[:strong].astype(int), swept.rho[:strong], known[:strong]
    view = measured.chosen.views[number]
    truth = recording.depth(view.image)
    error, seen = np.empty(0), np.empty(0, bool)
    if truth is not None:
        true = _smooth(truth)[pixels[:, 1], pixels[:, 0]]
        rows = known & (true > 0.0)
        error = np.abs(1.0 / rho[rows] / true[rows] - 1.0).astype(np.float64)
        seen = _agrees(recording, measured, depths, number, pixels[rows], 1.0 / true[rows])
    same = None
    if ahead and view.image + ahead < len(recording.t_ns):
        check = partial(_same, recording, measured, number, view.image + ahead, pixels[known])
        same = check(rho[known]), check(rho[known] / WRONG)
    return Scored(strong, float(known.mean()), error, seen, same)


def _smooth(depth: F32) -> F32:
    """Depths whose 3x3 pixels are known and lie together; 0 elsewhere."""
    kernel = np.ones((3, 3), np.uint8)
    low, high = cv2.erode(depth, kernel), cv2.dilate(depth, kernel)
    return np.where((low > 0.1) & (high - low < 0.05 * depth), depth, np.float32(0.0))


def _same(
    recording: Recording, measured: Measured, number: int, index: int, pixels: F64, rho: F32
) -> float:
    """Share of patches that look the same in another image, by their depths."""
    view = measured.chosen.views[number]
    T_map_other = recording.groundtruth.pose_at(int(recording.t_ns[index]))
    others = [(recording.image(index), se3.inverse(T_map_other) @ view.T_map_cam)]
    camera = measured.chosen.cameras[view.camera]
    cost = _cost(recording.image(view.image), camera, others, pixels, rho)
    return float(np.mean(cost[_inside(others[0][1], camera, pixels, rho)] < 0.3))


def _agrees(
    recording: Recording, measured: Measured, depths: Depths, number: int, pixels: F64, rho: F32
) -> Bools:
    """Whether patches look the same in the view's own neighbours, by their depths."""
    views = measured.chosen.views
    view = views[number]
    others = [
        (recording.image(views[other].image), se3.inverse(views[other].T_map_cam) @ view.T_map_cam)
        for other in depths.neighbours(number)
    ]
    camera = measured.chosen.cameras[view.camera]
    return _cost(recording.image(view.image), camera, others, pixels, rho) < 0.15


def _cost(image: U8, camera: CameraModel, others: list, pixels: F64, rho: F32) -> F32:  # type: ignore[type-arg]
    """Mean of 1 - correlation (n,) of patches in other images, by their depths."""
    own = fine_image(image, camera)
    rotated, shifts = derotated(
        own, [fine_image(other, camera) for other, _ in others], [T for _, T in others],
        float(rho.max()),
    )  # fmt: skip
    grey, valid = (np.stack(row) for row in zip(*rotated, strict=True))
    n = len(rho)
    found = [np.zeros(n, kind) for kind in (np.float32, np.float32, np.float32, np.uint8)]
    kernels_multiview.refine(
        own.grey.astype(np.float32), grey.astype(np.float32), valid, shifts,
        pixels.astype(np.int32), rho.astype(np.float32), np.float32(1e-5), *found,
    )  # fmt: skip
    return found[2]


def _inside(T: F64, camera, pixels: F64, rho: F32) -> Bools:  # type: ignore[no-untyped-def]
    """Which points lie well inside of the other image."""
    rays = np.column_stack((camera.normalise(pixels), np.ones(len(rho))))
    seen = camera.project(se3.transform(T, rays / rho[:, None]))
    return ((seen > 8) & (seen < (camera.width - 9, camera.height - 9))).all(axis=1)


def draw(recording: Recording, measured: Measured, depths: Depths, number: int) -> F32:
    """An image with its known depths in colours, near is red."""
    swept, known = depths.swept(number), depths.agreed(number)
    image = recording.image(measured.chosen.views[number].image)
    canvas = cv2.cvtColor(image // 2, cv2.COLOR_GRAY2BGR)
    low, high = np.percentile(swept.rho[known], (2, 98))
    grade = np.clip(255 * (swept.rho[known] - low) / (high - low), 0, 255).astype(np.uint8)
    u, v = swept.pixels[known].T
    canvas[v, u] = cv2.applyColorMap(grade[:, None], cv2.COLORMAP_TURBO)[:, 0]
    return cv2.resize(np.hstack((cv2.cvtColor(image, cv2.COLOR_GRAY2BGR), canvas)), (1280, 480))


if __name__ == "__main__":
    main()
