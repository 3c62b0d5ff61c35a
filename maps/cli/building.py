# SPDX-License-Identifier: Apache-2.0
"""The command that compiles a map."""

import argparse
import re
from pathlib import Path
from typing import TYPE_CHECKING

from edge.cli.command_line import Commands, indices, positive, span
from edge.errors import EdgeError

if TYPE_CHECKING:
    from maps.scale import Hint


def add(commands: Commands) -> None:
    """Add `build`."""
    parser = commands.add_parser(
        "build",
        help="compile a map from images",
        description="Compile a map from the images of recordings, whose poses share one frame or, "
        "with --poses sfm, are found here. Started again after an interruption, it goes on where "
        "it was.",
    )
    parser.set_defaults(run=_build)
    parser.add_argument(
        "sequences", type=Path, nargs="+", metavar="SEQUENCE", help="folder or file of a recording"
    )
    parser.add_argument(
        "--out",
        type=Path,
        required=True,
        metavar="MAP",
        help="folder to write; an earlier map there is replaced as a whole",
    )
    parser.add_argument("--frames", type=span, metavar="A:B", help="images A to B - 1 only")
    parser.add_argument("--every", type=positive, default=1, metavar="K", help="each K-th of them")
    parser.add_argument(
        "--exclude",
        type=indices,
        default=frozenset(),
        metavar="I,J,...",
        help="indices of images to leave out, in each sequence",
    )
    parser.add_argument(
        "--poses",
        choices=["given", "sfm"],
        default="given",
        help="given: those of the recording (default); sfm: from the images alone",
    )
    parser.add_argument(
        "--scale",
        type=_hint,
        metavar="HINT",
        help="what tells metres to poses without: given (poses of the recording, for sfm), metres "
        "(they are metres), depth (depth images), distance:I,J=METRES (between two cameras) or "
        "marker:FAMILY=SIDE_M (as marker:4X4_50=0.16)",
    )
    parser.add_argument(
        "--sfm", type=Path, metavar="FILE", help="keep what sfm finds here, and take it from here"
    )
    parser.add_argument(
        "--depth",
        choices=["none", "given", "stereo", "multiview", "lidar"],
        default="given",
        help="given: depth images where there are some (default); stereo: from the right camera; "
        "multiview: from the other images; lidar: from the laser scans",
    )
    parser.add_argument(
        "--lens",
        choices=["given", "refined"],
        default="refined",
        help="refined: let the images correct their calibration, where they clearly do (default)",
    )
    parser.add_argument(
        "--shutter",
        choices=["global", "found"],
        default="found",
        help="found: let images and poses tell how long a rolling shutter took, where they clearly "
        "do (default); global: all rows are of the stamp",
    )
    parser.add_argument(
        "--segmenter",
        type=Path,
        metavar="MODEL.onnx",
        help="label points and objects with this segmentation model, so that changes are found",
    )
    parser.add_argument(
        "--lines", action="store_true", help="find lines, too: they help where texture is scarce"
    )
    parser.add_argument(
        "--features",
        type=Path,
        metavar="MODEL.onnx",
        help="describe key points with this model, too; relocalise.features names it on the device",
    )
    parser.add_argument(
        "--markers",
        default="",
        metavar="FAMILY",
        help="store where square markers hang (as 4X4_50), so that they tell the pose at once",
    )
    parser.add_argument(
        "--tile-m", type=_length, default=None, metavar="M", help="side of a tile (40)"
    )
    parser.add_argument("--workers", type=positive, default=1, metavar="N", help="processes (1)")
    parser.add_argument(
        "--dask",
        type=_scheduler,
        metavar="tcp://HOST:PORT",
        help="share the work out to a Dask cluster instead",
    )


def _build(arguments: argparse.Namespace) -> None:
    # Imported here, as OpenCV and Numba take a second that `--help` need not wait for.
    from maps.build import BuildInput, build
    from maps.settings import BuildSettings
    from maps.writer import is_map

    settings = BuildSettings(
        depth=arguments.depth,
        lens=arguments.lens,
        shutter=arguments.shutter,
        lines=arguments.lines,
        markers=arguments.markers,
        tile_m=arguments.tile_m or BuildSettings().tile_m,
    )
    source = BuildInput(
        arguments.sequences,
        arguments.frames,
        arguments.every,
        arguments.exclude,
        arguments.poses,
        arguments.scale,
        arguments.sfm,
    )
    replaces = is_map(arguments.out)
    report = build(
        source,
        arguments.out,
        settings,
        workers=arguments.workers,
        dask=arguments.dask,
        segmenter=arguments.segmenter,
        features=arguments.features,
    )
    counts = report.manifest.counts
    size = sum(file.bytes for file in report.manifest.files())
    print(
        f"{arguments.out}: {counts.keyframes} keyframes, {counts.points} points seen "
        f"{report.views_per_point:.1f} times each, median residual "
        f"{report.median_residual_px:.2f} px, {size / 1e6:.1f} MB "
        f"({size / counts.keyframes / 1e3:.0f} kB a keyframe) in {len(report.manifest.tiles)} tiles"
        + ("; the earlier map there is gone" if replaces else "")
    )
    for camera in report.manifest.cameras:
        if camera.replaces is not None:
            print(
                f"lens refined: f {camera.fx:.2f}, centre {camera.cx:.2f} {camera.cy:.2f}, "
                f"{camera.distortion_model} {' '.join(f'{k:.5f}' for k in camera.distortion)}"
            )
    for recording, readout_s in report.readouts_s.items():
        print(
            f"{recording}: its rows were read within {1e3 * readout_s:.1f} ms, which is taken off"
        )
    if report.skipped:
        print(f"{report.skipped} images have no pose and were left out")
    if not report.origin.metric:
        print("lengths are in no known unit (manifest: metric = false); --scale makes them metres")


def _hint(text: str) -> "Hint":
    from maps.scale import parse

    try:
        return parse(text)
    except EdgeError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def _scheduler(text: str) -> str:
    if not re.fullmatch(r"\w+://.+:\d+", text):
        raise argparse.ArgumentTypeError(f"{text!r} is no address like tcp://HOST:PORT")
    return text


def _length(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0.1 <= value <= 1e6:
        raise argparse.ArgumentTypeError(f"{text!r} is no length from 0.1 to 1000000")
    return value
