# SPDX-License-Identifier: Apache-2.0
"""What spoils localisation: the same drives as they are, and with images as bad as cameras give.

python -m tools.bench.localisation_spoiled DATA [--maps FOLDER] [--drive NAME] [--only KIND ...]

Nothing is aligned: poses are compared with the truth of the recording. `wrong` counts poses that
are more than 5 cm and 3 published sigmas off. Worse images may take poses away, or make them less
exact; they must not make them wrong.
"""

import argparse
import tempfile
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from edge.cameras.recording import open_recording
from edge.config import Config
from edge.geometry.camera import CameraModel
from edge.runtime.kernel_cache import use_kernel_cache
from edge.runtime.warm_up import warm_up
from edge.types import F64, U8, Frame, Mat4
from tools.bench.localisation import truth_of
from tools.bench.localisation_must_hold import DRIVES, Drive, map_for
from tools.bench.localisation_runs import Played, play, score
from tools.bench.localisation_setups import seen_by
from tools.bench.scoring import where_measured

_WRONG_M, _WRONG_SIGMAS = 0.05, 3.0
_QUARTER_TURN = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
Change = Callable[[U8, int, np.random.Generator], F64 | U8]  # of the n-th image


def _waves(image: U8, n: int, rng: np.random.Generator) -> F64:
    return image * (1.0 + 0.5 * np.sin(n / 7)) + 10.0 * np.sin(n / 5)


def _hand(image: U8, n: int, rng: np.random.Generator) -> U8:
    """Something large that moves in front of the camera."""
    height, width = image.shape
    middle = int(width * (0.5 + 0.3 * np.sin(n / 9))), int(height * (0.8 - 0.25 * np.cos(n / 13)))
    axes = int(0.19 * width), int(0.35 * height)
    return np.asarray(
        cv2.ellipse(image.copy(), middle, axes, 20.0, 0.0, 360.0, 150.0, -1), np.uint8
    )


def _spotlight(image: U8, n: int, rng: np.random.Generator) -> F64:
    height, width = image.shape
    v, u = np.mgrid[:height, :width]
    square = (u - 0.25 * width - n) ** 2 + (v - 0.3 * height) ** 2
    return image * (0.35 + 1.3 * np.exp(-square / (2.0 * (0.25 * width) ** 2)))


def _packed(image: U8, n: int, rng: np.random.Generator) -> U8:
    _, packed = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 20])
    return np.asarray(cv2.imdecode(packed, cv2.IMREAD_GRAYSCALE), np.uint8)


CHANGES: dict[str, Change] = {
    "dark, noisy": lambda image, n, rng: 0.3 * image + rng.normal(0.0, 1.5, image.shape),
    "overexposed": lambda image, n, rng: 1.8 * image.astype(np.float64),
    "exposure goes up and down": _waves,
    "spotlight": _spotlight,
    "noise of 10": lambda image, n, rng: image + rng.normal(0.0, 10.0, image.shape),
    "blurred by 15 px, half of the time": lambda image, n, rng: (
        np.asarray(cv2.blur(image, (15, 1))) if n // 15 % 2 else image
    ),
    "JPEG of quality 20": _packed,
    "a hand in front": _hand,
}
# Of each 50 frames, or of each three: which of them come.
KEPT: dict[str, Callable[[int], bool]] = {
    "every third frame missing": lambda n: n % 3 != 2,
    "12 of 50 frames missing": lambda n: n % 50 < 38,
    "every sixth frame": lambda n: n % 6 == 0,
}


class View(NamedTuple):
    """The recording's images as another camera would give them, turned about its axis."""

    camera: Callable[[CameraModel], CameraModel]
    quarter_turns: int = 0


def _resized(camera: CameraModel, factor: float) -> CameraModel:
    return CameraModel(
        round(factor * camera.width),
        round(factor * camera.height),
        factor * camera.fx,
        factor * camera.fy,
        factor * (camera.cx + 0.5) - 0.5,
        factor * (camera.cy + 0.5) - 0.5,
        camera.distortion_model,
        camera.distortion,
    )


def _turned(camera: CameraModel) -> CameraModel:
    """Turned clockwise by a quarter; of lenses only those that do not bend."""
    middle = camera.height - 1.0 - camera.cy, camera.cx
    return CameraModel(camera.height, camera.width, camera.fy, camera.fx, *middle)


VIEWS = {
    "half the size": View(lambda camera: _resized(camera, 0.5)),
    "on its side": View(_turned, 1),
    "upside down": View(lambda camera: _turned(_turned(camera)), 2),
}


def main() -> None:
    """Run and print the table."""
    parser = argparse.ArgumentParser(description="Localisation by spoilt images.")
    kinds = ["as it is", *CHANGES, *KEPT, *VIEWS]
    parser.add_argument("data", type=Path)
    parser.add_argument("--maps", type=Path, default=None, help="where maps are built and kept")
    names = [drive.name for drive in DRIVES]
    parser.add_argument("--drive", nargs="+", default=["kitchen back"], choices=names)
    parser.add_argument("--only", nargs="+", default=kinds, choices=kinds, metavar="KIND")
    arguments = parser.parse_args()
    use_kernel_cache()
    cv2.setNumThreads(1)
    warm_up(Config())
    print(where_measured())
    with tempfile.TemporaryDirectory() as made:
        maps = arguments.maps or Path(made)
        for drive in (drive for drive in DRIVES if drive.name in arguments.drive):
            print(f"\n{drive.name:36} poses  first s  median cm  p95 cm  max cm   NEES  wrong")
            for kind in arguments.only:
                print(_row(kind, drive, arguments.data, maps), flush=True)


def _row(kind: str, drive: Drive, data: Path, maps: Path) -> str:
    played = _played(kind, drive, data, maps)
    s = score(played, drive.truth_sigma_m)
    off = np.concatenate((s.enough, s.scarce))
    p50, p95, most = np.percentile(off, (50, 95, 100)) if len(off) else (np.nan,) * 3
    return (
        f"  {kind:34} {s.published:3d}/{s.frames:<3d} {s.first_after_s:5.2f} "
        f"{p50:10.2f} {p95:7.2f} {most:7.2f} {s.nees:6.2f} {_wrong(played):6d}"
    )


def _wrong(played: Played) -> int:
    wrong = 0
    for report, T in zip(played.reports, played.truth, strict=True):
        if report.pose is None or T is None:
            continue
        off = report.pose.T_map_cam[:3, 3] - T[:3, 3]
        far = float(np.linalg.norm(off))
        sigma = np.sqrt(off @ report.pose.covariance[:3, :3] @ off) / max(far, 1e-12)
        wrong += far > _WRONG_M and far > _WRONG_SIGMAS * sigma
    return wrong


def _played(kind: str, drive: Drive, data: Path, maps: Path) -> Played:
    recording = open_recording(data / drive.query[0], frames=drive.query[1])
    truth, camera = truth_of(recording), recording.camera
    frames: Iterable[Frame] = recording
    if kind in CHANGES:
        frames = _changed(recording, CHANGES[kind])
    elif kind in KEPT:
        frames = (frame for n, frame in enumerate(recording) if KEPT[kind](n))
    elif kind in VIEWS:
        view = VIEWS[kind]
        camera = view.camera(camera)
        frames = _seen(recording, recording.camera, camera, view.quarter_turns)
    T_recorded_cam = np.eye(4)
    T_recorded_cam[:3, :3] = _turn(VIEWS[kind].quarter_turns).T if kind in VIEWS else np.eye(3)

    def truth_at(t_ns: int) -> Mat4 | None:
        T = truth(t_ns)
        return None if T is None else T @ T_recorded_cam

    return play(frames, camera, map_for(data, maps, *drive.map_of), truth_at)


def _changed(frames: Iterable[Frame], change: Change) -> Iterator[Frame]:
    rng = np.random.default_rng(0)
    for n, frame in enumerate(frames):
        image = np.clip(change(frame.image, n, rng), 0, 255).astype(np.uint8)
        yield Frame(frame.index, frame.t_ns, image)


def _seen(
    frames: Iterable[Frame], camera: CameraModel, other: CameraModel, quarter_turns: int
) -> Iterator[Frame]:
    if quarter_turns == 0:
        yield from seen_by(frames, camera, other)
        return
    for frame in frames:
        image = np.ascontiguousarray(np.rot90(frame.image, -quarter_turns))
        yield Frame(frame.index, frame.t_ns, image)


def _turn(quarter_turns: int) -> F64:
    """Rotation of points into the axes of a camera that was turned clockwise."""
    return np.linalg.matrix_power(_QUARTER_TURN, quarter_turns)


if __name__ == "__main__":
    main()
