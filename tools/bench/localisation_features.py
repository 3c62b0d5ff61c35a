# SPDX-License-Identifier: Apache-2.0
"""A learned model's features beside ORB's: single images in one map that has both.

python -m tools.bench.localisation_features MODEL.onnx RECORDING --map-frames A:B --frames A:B
    [--every K] [--stride K] [--map MAP]

`lost` takes each image alone, `led` gives a prior thrown around the truth. Without MAP one is
built and thrown away. Published on the kitchen (redkitchen): hloc (SuperPoint and SuperGlue, on a
GPU) 1.1 cm and 98.6 % of the official test within 5 cm, SIFT on a CPU 0.77 cm at 221 ms a query.
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
from edge.runtime.kernel_cache import use_kernel_cache
from edge.runtime.learned import make_relocaliser
from edge.tiles.reader import Map, open_map
from edge.types import Query
from maps.build import BuildInput, build
from maps.settings import BuildSettings
from tools.bench.localisation import HEADER, Row, prior_thrown, truth_of
from tools.bench.scoring import where_measured


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("model", type=Path)
    parser.add_argument("recording", type=Path)
    parser.add_argument("--map-frames", type=span, required=True)
    parser.add_argument("--frames", type=span, required=True)
    parser.add_argument("--every", type=int, default=5)
    parser.add_argument("--stride", type=int, default=4)
    parser.add_argument("--map", type=Path)
    parser.add_argument("--truth-sigma-m", type=float, default=0.005)
    arguments = parser.parse_args()
    use_kernel_cache()
    cv2.setNumThreads(1)
    print(where_measured())
    with tempfile.TemporaryDirectory() as made:
        folder = arguments.map or Path(made) / "map"
        if arguments.map is None:
            source = BuildInput([arguments.recording], arguments.map_frames, arguments.every)
            build(source, folder, BuildSettings(), features=arguments.model)
        map_ = open_map(folder)
        print(HEADER)
        for features in ("orb", str(arguments.model)):
            for mode in ("lost", "led"):
                print(row(arguments, map_, features, mode).line(foreign=False), flush=True)
    return 0


def row(arguments: argparse.Namespace, map_: Map, features: str, mode: str) -> Row:
    """What the images give by one kind of features."""
    recording = open_recording(
        arguments.recording, frames=arguments.frames, stride=arguments.stride
    )
    config = RelocaliseConfig(features=features)
    relocaliser = make_relocaliser(map_, recording.camera, config)
    truth, rng = truth_of(recording), np.random.default_rng(0)
    told = Row(f"{Path(features).name}, {mode}")
    for frame in recording:
        T_true = truth(frame.t_ns)
        if T_true is None:
            continue
        query = prior_thrown(Query(frame), T_true, rng) if mode == "led" else Query(frame)
        began = time.thread_time()
        fix = relocaliser.step(query)
        told.ms.append(1e3 * (time.thread_time() - began))
        told.asked += 1
        if fix.found and fix.T_map_cam is not None and fix.covariance is not None:
            told.take(fix.T_map_cam, fix.covariance, T_true, arguments.truth_sigma_m)
        else:
            told.reasons[fix.reason] += 1
    return told


if __name__ == "__main__":
    sys.exit(main())
