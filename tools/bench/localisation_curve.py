# SPDX-License-Identifier: Apache-2.0
"""Recall and precision of single images, spoilt and foreign ones among them, by what is believed.

python -m tools.bench.localisation_curve --map MAP --own RECORDING [A:B] --foreign RECORDING ...
    [--every K] [--picture FILE.png]

Three ways to the same images: the method of 2021 (best keyframe alone, believed by its number of
inliers), ours with its gates open (believed by inliers or by its own standard deviation), and ours
as it is: one point. A fix is right within 20 cm of the truth; of a foreign place, black, white or
noise none is. Recall is the share of the map's place's images that are rightly found.
"""

import argparse
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import cv2
import msgspec
import numpy as np

from edge.cameras.recording import Recording, open_recording
from edge.cli.command_line import span
from edge.config.relocalise import RelocaliseConfig
from edge.geometry.covariance import position_sigma
from edge.relocalise.features import OrbExtractor
from edge.relocalise.relocaliser import Relocaliser
from edge.runtime.kernel_cache import use_kernel_cache
from edge.tiles.reader import open_map
from edge.types import F64, U8, Bools, Frame, Mat4, Query
from tools.bench.localisation import WRONG_M, truth_of
from tools.bench.localisation_thinned import SEED
from tools.bench.scoring import where_measured

OPEN = msgspec.structs.replace(
    RelocaliseConfig(),
    min_inliers=SEED.min_inliers,
    min_cells=SEED.min_cells,
    min_spread=SEED.min_spread,
    min_evidence=SEED.min_evidence,
    max_sigma_depth_share=SEED.max_sigma_depth_share,
    max_sigma_deg=SEED.max_sigma_deg,
    max_rival_share=SEED.max_rival_share,
)
METHODS = {"seed": SEED, "open": OPEN, "ours": RelocaliseConfig()}
PRECISIONS = (1.0, 0.999, 0.99)


class Answer(NamedTuple):
    """What one method said of one image."""

    kind: str
    findable: bool  # the image shows the map's place
    found: bool
    right: bool
    inliers: int
    sigma_m: float


def spoilt(image: U8, rng: np.random.Generator) -> Iterator[tuple[str, U8]]:
    """The image, and what may become of it."""
    yield "plain", image
    yield "blurred", cv2.GaussianBlur(image, (0, 0), 2.0).astype(np.uint8)
    yield "blurred much", cv2.GaussianBlur(image, (0, 0), 4.0).astype(np.uint8)
    dark = image.astype(np.float32) / 8.0 + rng.normal(0.0, 1.5, image.shape)
    yield "dark", np.clip(dark, 0, 255).astype(np.uint8)
    for kind, share in (("a third covered", 0.33), ("most covered", 0.75)):
        out = image.copy()
        height, width = out.shape
        wide = int(share * width)
        left = int(rng.integers(0, width - wide + 1))
        block = rng.integers(0, 256, (height // 8 + 1, wide // 8 + 1), np.uint8)
        cover = cv2.resize(block, (wide, height), interpolation=cv2.INTER_LINEAR)
        out[:, left : left + wide] = cover
        yield kind, out


def nothing(shape: tuple[int, ...], rng: np.random.Generator) -> Iterator[tuple[str, U8]]:
    """Images of no place."""
    yield "black", np.zeros(shape, np.uint8)
    yield "white", np.full(shape, 255, np.uint8)
    yield "noise", rng.integers(0, 256, shape, np.uint8)
    soft = cv2.GaussianBlur(rng.integers(0, 256, shape, np.uint8), (0, 0), 2.0)
    yield "soft noise", cv2.normalize(soft, soft, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)


Asked = tuple[str, U8, Mat4 | None]  # kind, image, truth where there is one


def queries(recording: Recording, *, own: bool, rng: np.random.Generator) -> Iterator[Asked]:
    """Every image of a recording, whole and spoilt."""
    truth = truth_of(recording)
    for number, frame in enumerate(recording):
        if own:
            T = truth(frame.t_ns)
            if T is not None:
                yield from ((kind, image, T) for kind, image in spoilt(frame.image, rng))
        else:
            yield "foreign", frame.image, None
        mirrored = np.ascontiguousarray(frame.image[:, ::-1])
        yield "mirrored" if own else "foreign, mirrored", mirrored, None
        if number % 10 == 0:
            yield from ((kind, image, None) for kind, image in nothing(frame.image.shape, rng))


def answers(
    map_folder: Path, recordings: list[tuple[Recording, bool]]
) -> tuple[dict[str, list[Answer]], dict[str, float]]:
    """All that each method says, and its CPU time for an image [ms] without extraction."""
    map_, rng = open_map(map_folder), np.random.default_rng(0)
    extractor = OrbExtractor(map_.manifest.extractor)
    said: dict[str, list[Answer]] = {name: [] for name in METHODS}
    spent = dict.fromkeys(METHODS, 0.0)
    for recording, own in recordings:
        camera = map_.camera_for(recording.camera)
        ways = {name: Relocaliser(map_, camera, config) for name, config in METHODS.items()}
        for index, (kind, image, T) in enumerate(queries(recording, own=own, rng=rng)):
            features = extractor.extract(image, camera)
            for name, way in ways.items():
                began = time.thread_time()
                attempt = way.attempt(features, Query(Frame(index, index, image)))
                spent[name] += time.thread_time() - began
                found, solution = attempt.reason == "ok", attempt.solution
                off, inliers, sigma = np.inf, 0, np.inf
                if solution is not None:
                    inliers = int(np.count_nonzero(solution.inlier))
                    sigma = position_sigma(solution.covariance)
                    if T is not None:
                        off = float(np.linalg.norm(solution.T_map_cam[:3, 3] - T[:3, 3]))
                right = found and off <= WRONG_M
                said[name].append(Answer(kind, T is not None, found, right, inliers, sigma))
    return said, {name: 1e3 * s / max(len(said[name]), 1) for name, s in spent.items()}


def curve(said: list[Answer], worth: Callable[[Answer], float]) -> tuple[F64, F64]:
    """Recall and precision (n,) as ever less worthy fixes are believed."""
    fixes = sorted((a for a in said if a.found), key=worth, reverse=True)
    right: Bools = np.array([a.right for a in fixes], bool)
    taken = np.arange(1, len(fixes) + 1)
    findable = max(sum(a.findable for a in said), 1)
    return np.cumsum(right) / findable, np.cumsum(right) / np.maximum(taken, 1)


def table(said: dict[str, list[Answer]], ms: dict[str, float]) -> None:
    """Print what became of each kind, and what can be had at which precision."""
    names = list(said)
    print(f"{'':20s} {'asked':>5s} " + " ".join(f"{n + ': right, wrong':>20s}" for n in names))
    for kind in dict.fromkeys(a.kind for a in said["ours"]):
        cells = []
        for name in names:
            of_kind = [a for a in said[name] if a.kind == kind]
            right = sum(a.right for a in of_kind)
            cells.append(f"{right:13d}, {sum(a.found for a in of_kind) - right:5d}")
        print(f"{kind:20s} {len(of_kind):5d} " + " ".join(f"{cell:>20s}" for cell in cells))
    print(
        "CPU ms an image, without extraction: " + ", ".join(f"{n} {v:.0f}" for n, v in ms.items())
    )
    for name, (recall, precision) in curves(said).items():
        had = [recall[precision >= p].max(initial=0.0) for p in PRECISIONS]
        at = ", ".join(
            f"{100 * r:5.1f}% at {100 * p:g}%" for r, p in zip(had, PRECISIONS, strict=True)
        )
        print(f"{name:18s} recall by precision: {at}")
    ours = said["ours"]
    right, found = sum(a.right for a in ours), sum(a.found for a in ours)
    print(
        f"{'ours':18s} recall {100 * right / max(sum(a.findable for a in ours), 1):5.1f}% "
        f"at precision {100 * right / max(found, 1):g}%"
    )


def curves(said: dict[str, list[Answer]]) -> dict[str, tuple[F64, F64]]:
    """Recall and precision by what is believed."""
    return {
        "seed, by inliers": curve(said["seed"], lambda a: a.inliers),
        "open, by inliers": curve(said["open"], lambda a: a.inliers),
        "open, by sigma": curve(said["open"], lambda a: -a.sigma_m),
        "ours, by sigma": curve(said["ours"], lambda a: -a.sigma_m),
    }


def draw(said: dict[str, list[Answer]], path: Path) -> None:
    """Picture of the curves."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 5), layout="constrained")
    axes = figure.add_subplot(xlabel="recall", ylabel="precision", xlim=(0, 1), ylim=(0.5, 1.005))
    for name, (recall, precision) in curves(said).items():
        axes.plot(recall, precision, label=name)
        if name.startswith("ours") and len(recall):
            axes.plot(recall[-1], precision[-1], "o", color=axes.lines[-1].get_color())
    axes.legend(loc="lower left")
    axes.grid(alpha=0.3)
    figure.savefig(path, dpi=110)


def main() -> int:
    """Print the table; 1 where ours believed a wrong fix."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--map", type=Path, required=True)
    parser.add_argument("--own", nargs="+", required=True, metavar="RECORDING [A:B]")
    parser.add_argument("--foreign", type=Path, nargs="*", default=[])
    parser.add_argument("--every", type=int, default=4)
    parser.add_argument("--picture", type=Path)
    arguments = parser.parse_args()
    use_kernel_cache()
    cv2.setNumThreads(1)
    frames = span(arguments.own[1]) if len(arguments.own) > 1 else None
    recordings = [(open_recording(arguments.own[0], frames=frames, stride=arguments.every), True)]
    recordings += [(open_recording(f, stride=arguments.every), False) for f in arguments.foreign]
    said, ms = answers(arguments.map, recordings)
    print(where_measured())
    table(said, ms)
    if arguments.picture:
        draw(said, arguments.picture)
        print(f"picture: {arguments.picture}")
    return int(any(a.found and not a.right for a in said["ours"]))


if __name__ == "__main__":
    sys.exit(main())
