# SPDX-License-Identifier: Apache-2.0
"""False fixes: images in maps of other places, mirrored, turned, black, white, noise.

python -m tools.bench.localisation_negatives --map MAP ... --recording RECORDING ... [--every K]
    [--own MAP RECORDING ...] [--world MAP RECORDING ...]

Every recording is looked for in every map. A pair named by --own shows the map's place: of it only
spoilt images are asked, for a whole one would be right. To try the gates on rooms that look alike,
make them with the simulator: one style, other seeds. What stands the same in two such rooms is no
negative: --world names the recording that a map was built from, and fixes on surfaces that both
rooms have at the same place, found from where they were taken, are counted apart.
"""

import argparse
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from edge.cameras.recording import open_recording
from edge.config import Config
from edge.config.relocalise import RelocaliseConfig
from edge.relocalise.confirm import Attempt
from edge.relocalise.features import Features, OrbExtractor
from edge.relocalise.gates import LITTLE_SEEN
from edge.relocalise.relocaliser import Relocaliser
from edge.runtime.kernel_cache import use_kernel_cache
from edge.tiles.reader import open_map
from edge.types import U8, Frame, Mat4, Query
from tools.bench.localisation import truth_of
from tools.bench.localisation_same import SAME_SHARE, SameSurface, world_of
from tools.bench.scoring import where_measured

PLAIN = "plain"
_SPOILT_EVERY = 3  # in foreign maps plain images matter most


def images(frame: Frame, *, own: bool) -> Iterator[tuple[str, U8]]:
    """What is asked of one frame; none of it shows the map's place."""
    if not own:
        yield PLAIN, frame.image
    if own or frame.index % _SPOILT_EVERY == 0:
        yield "mirrored", np.ascontiguousarray(frame.image[:, ::-1])
        yield "upside down mirrored", np.ascontiguousarray(frame.image[::-1])
        blurred = cv2.GaussianBlur(frame.image[:, ::-1], (0, 0), 4.0).astype(np.uint8)
        yield "mirrored, blurred", blurred


def blanks(shape: tuple[int, ...]) -> Iterator[tuple[str, U8]]:
    """Images of nothing."""
    rng = np.random.default_rng(0)
    yield "black", np.zeros(shape, np.uint8)
    yield "white", np.full(shape, 255, np.uint8)
    for _ in range(3):
        yield "noise", rng.integers(0, 256, shape, np.uint8)
        yield "soft noise", cv2.GaussianBlur(rng.integers(0, 256, shape, np.uint8), (0, 0), 2.0)


class Tally:
    """What came of all queries."""

    def __init__(self) -> None:
        self.asked = Counter[str]()
        self.false = self.same = 0
        self.pooled: list[int] = []
        self.nearest = 0.0  # evidence for a pose that was refused for want of it

    def take(self, kind: str, attempt: Attempt) -> bool:
        """Count an attempt; whether it is believed."""
        self.asked[kind] += 1
        self.pooled.append(attempt.matches)
        if attempt.reason == LITTLE_SEEN and attempt.seen is not None:
            self.nearest = max(self.nearest, attempt.seen.evidence)
        return attempt.reason == "ok"

    def text(self, config: RelocaliseConfig) -> str:
        """All of it."""
        many = float(np.mean(np.array(self.pooled) >= 50))
        return (
            ", ".join(f"{kind} {n}" for kind, n in self.asked.items())
            + f"\n{sum(self.asked.values())} asked, {self.false} false, {self.same} of what stands "
            + f"the same in both rooms; {100 * many:.0f}% with 50 matches or more\n"
            + f"refused by evidence alone with up to {self.nearest:.3f} of {config.min_evidence:g}"
        )


def share_same(
    same: SameSurface | None, T_true: Mat4 | None, attempt: Attempt, features: Features
) -> float:
    """Of the matches that a fix rests on, those of surfaces that stand the same in both rooms."""
    if same is None or T_true is None or attempt.solution is None or attempt.found is None:
        return 0.0
    pixels = features.pixels[attempt.found.feature[attempt.solution.inlier]]
    return same.share(T_true, attempt.solution.T_map_cam, pixels)


def ask(
    tally: Tally, folder: Path, map_folder: Path, every: int, *, own: bool, world: Path | None
) -> None:
    """Look for all images of a recording in a map."""
    recording = open_recording(folder, stride=every)
    frames, truth = list(recording), truth_of(recording)
    map_ = open_map(map_folder)
    camera = map_.camera_for(recording.camera)
    relocaliser = Relocaliser(map_, camera, Config().relocalise)
    extractor = OrbExtractor(map_.manifest.extractor)
    here, there = world_of(folder), None if world is None else world_of(world)
    same = None if here is None or there is None else SameSurface(here, there, camera)
    queries = [(f, *image) for f in frames for image in images(f, own=own)]
    queries += [(frames[0], *blank) for blank in blanks(frames[0].image.shape)]
    for frame, kind, image in queries:
        features = extractor.extract(image, camera)
        attempt = relocaliser.attempt(features, Query(Frame(frame.index, frame.t_ns, image)))
        if not tally.take(kind, attempt) or attempt.seen is None:
            continue
        T_true = truth(frame.t_ns) if kind == PLAIN else None
        share = share_same(same, T_true, attempt, features)
        alike = share >= SAME_SHARE
        tally.same += alike
        tally.false += not alike
        print(
            f"{'SAME' if alike else 'FALSE'} {folder} {frame.index} {kind} in {map_folder}: "
            f"evidence {attempt.seen.evidence:.3f}, {100 * share:.0f}% on what stands the same"
        )


def main() -> int:
    """Print the counts; 1 where any false fix was believed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--map", type=Path, nargs="+", required=True)
    parser.add_argument("--recording", type=Path, nargs="+", required=True)
    parser.add_argument("--own", type=Path, nargs=2, action="append", default=[])
    parser.add_argument("--world", type=Path, nargs=2, action="append", default=[])
    parser.add_argument("--every", type=int, default=10)
    arguments = parser.parse_args()
    use_kernel_cache()
    cv2.setNumThreads(1)
    print(where_measured())
    tally, worlds = Tally(), dict(arguments.world)
    for folder in arguments.recording:
        for map_folder in arguments.map:
            own = [map_folder, folder] in arguments.own
            world = worlds.get(map_folder)
            ask(tally, folder, map_folder, arguments.every, own=own, world=world)
    print(tally.text(Config().relocalise))
    return int(tally.false > 0)


if __name__ == "__main__":
    sys.exit(main())
