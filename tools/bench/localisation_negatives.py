# SPDX-License-Identifier: Apache-2.0
"""False fixes: images in maps of other places, mirrored, turned, black, white, noise.

python -m tools.bench.localisation_negatives --map MAP ... --recording RECORDING ... [--every K]
    [--own MAP RECORDING ...]

Every recording is looked for in every map. A pair named by --own shows the map's place: of it only
spoilt images are asked, for a whole one would be right. To try the gates on rooms that look alike,
make them with the simulator: one style, other seeds.
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
from edge.relocalise.features import OrbExtractor
from edge.relocalise.gates import LITTLE_SEEN
from edge.relocalise.relocaliser import Relocaliser
from edge.runtime.kernel_cache import use_kernel_cache
from edge.tiles.reader import open_map
from edge.types import U8, Frame, Query
from tools.bench.scoring import where_measured

_SPOILT_EVERY = 3  # in foreign maps plain images matter most


def images(frame: Frame, *, own: bool) -> Iterator[tuple[str, U8]]:
    """What is asked of one frame; none of it shows the map's place."""
    if not own:
        yield "plain", frame.image
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


def main() -> int:
    """Print the counts; 1 where any fix was believed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--map", type=Path, nargs="+", required=True)
    parser.add_argument("--recording", type=Path, nargs="+", required=True)
    parser.add_argument("--own", type=Path, nargs=2, action="append", default=[])
    parser.add_argument("--every", type=int, default=10)
    arguments = parser.parse_args()
    use_kernel_cache()
    cv2.setNumThreads(1)
    print(where_measured())
    config = Config().relocalise
    asked, false, pooled, nearest = Counter[str](), 0, [], 0.0
    for folder in arguments.recording:
        recording = open_recording(folder, stride=arguments.every)
        frames = list(recording)
        for map_folder in arguments.map:
            own = [map_folder, folder] in arguments.own
            map_ = open_map(map_folder)
            camera = map_.camera_for(recording.camera)
            relocaliser = Relocaliser(map_, camera, config)
            extractor = OrbExtractor(map_.manifest.extractor)
            queries = [(f, *image) for f in frames for image in images(f, own=own)]
            queries += [(frames[0], *blank) for blank in blanks(frames[0].image.shape)]
            for frame, kind, image in queries:
                features = extractor.extract(image, camera)
                query = Query(Frame(frame.index, frame.t_ns, image))
                attempt = relocaliser.attempt(features, query)
                asked[kind] += 1
                pooled.append(attempt.matches)
                if attempt.reason == LITTLE_SEEN and attempt.seen is not None:
                    nearest = max(nearest, attempt.seen.evidence)
                if attempt.reason == "ok" and attempt.seen is not None:
                    false += 1
                    seen = f"evidence {attempt.seen.evidence:.3f}"
                    print(f"FALSE {folder} {frame.index} {kind} in {map_folder}: {seen}")
    many = float(np.mean(np.array(pooled) >= 50))
    print(", ".join(f"{kind} {n}" for kind, n in asked.items()))
    print(f"{sum(asked.values())} asked, {false} false; {100 * many:.0f}% with 50 matches or more")
    print(f"refused by evidence alone with up to {nearest:.3f} of {config.min_evidence:g}")
    return int(false > 0)


if __name__ == "__main__":
    sys.exit(main())
