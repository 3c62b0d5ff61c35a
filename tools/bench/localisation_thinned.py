# SPDX-License-Identifier: Apache-2.0
"""Single images in maps of fewer and fewer keyframes: the method of 2021 beside ours.

python -m tools.bench.localisation_thinned RECORDING --map-frames A:B --frames A:B
    [--every 1 3 5 7 10 20] [--stride K]

The seed method is ours by configuration: the best keyframe alone by its words, no gate but ten
inliers. Recall is the share of queries that are found within 5 cm; false are those found and off
by more than 20 cm.
"""

import argparse
import sys
import tempfile
import time
from pathlib import Path

import cv2
import numpy as np

from edge.cameras.recording import open_recording
from edge.cli.command_line import span
from edge.config.relocalise import RelocaliseConfig
from edge.relocalise.relocaliser import Relocaliser
from edge.runtime.kernel_cache import use_kernel_cache
from edge.tiles.reader import open_map
from edge.types import Query
from maps.build import BuildInput, build
from maps.settings import BuildSettings
from tools.bench.localisation import WRONG_M, truth_of
from tools.bench.scoring import where_measured

SEED = RelocaliseConfig(
    retrieved=1,
    pooled=1,
    covisible=0,
    near_last_place=0,
    guided=False,
    min_matches=8,
    min_inliers=10,
    min_cells=1,
    min_spread=0.0,
    min_evidence=0.0,
    max_sigma_depth_share=1.0,
    max_sigma_deg=90.0,
    max_rival_share=1.0,
)
RECALLED_M = 0.05


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("recording", type=Path)
    parser.add_argument("--map-frames", type=span, required=True)
    parser.add_argument("--frames", type=span, required=True)
    parser.add_argument("--every", type=int, nargs="+", default=[1, 3, 5, 7, 10, 20])
    parser.add_argument("--stride", type=int, default=4)
    arguments = parser.parse_args()
    use_kernel_cache()
    cv2.setNumThreads(1)
    print(where_measured())
    counts = f"{'asked':>5s} {'found':>5s} {'false':>5s}"
    print(f"{'map':>9s} {'method':6s} {counts} recall  med cm   ms  p95")
    with tempfile.TemporaryDirectory() as made:
        for every in arguments.every:
            folder = Path(made) / str(every)
            source = BuildInput([arguments.recording], arguments.map_frames, every)
            build(source, folder, BuildSettings())
            for name, config in (("seed", SEED), ("ours", RelocaliseConfig())):
                print(f"every {every:3d} {name:6s} {row(arguments, folder, config)}", flush=True)
    return 0


def row(arguments: argparse.Namespace, map_folder: Path, config: RelocaliseConfig) -> str:
    """Figures of one method in one map."""
    recording = open_recording(
        arguments.recording, frames=arguments.frames, stride=arguments.stride
    )
    relocaliser = Relocaliser(open_map(map_folder), recording.camera, config)
    truth, asked, errors, ms = truth_of(recording), 0, [], []
    for frame in recording:
        T = truth(frame.t_ns)
        if T is None:
            continue
        began = time.thread_time()
        fix = relocaliser.step(Query(frame))
        ms.append(1e3 * (time.thread_time() - began))
        asked += 1
        if fix.found and fix.T_map_cam is not None:
            errors.append(float(np.linalg.norm(fix.T_map_cam[:3, 3] - T[:3, 3])))
    e = np.array(errors or [np.nan])
    return (
        f"{asked:5d} {len(errors):5d} {int(np.sum(e > WRONG_M)):5d} "
        f"{100 * np.sum(e <= RECALLED_M) / max(asked, 1):5.0f}% {100 * np.median(e):7.2f} "
        f"{np.median(ms):4.0f} {np.percentile(ms, 95):4.0f}"
    )


if __name__ == "__main__":
    sys.exit(main())
