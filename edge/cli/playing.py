# SPDX-License-Identifier: Apache-2.0
"""Commands that run on recordings and images, and draw what came out."""

from pathlib import Path

from edge.cli.command_line import Commands, picture, positive, span


def add(commands: Commands) -> None:
    """Add `replay`, `localise` and `plot`."""
    _add_replay(commands)
    _add_localise(commands)
    _add_plot(commands)


def _add_replay(commands: Commands) -> None:
    parser = commands.add_parser(
        "replay",
        help="run the pipeline on a recording",
        description="Run the whole pipeline on a recording and write a run folder. Without "
        "--realtime the same input gives the same files, byte for byte but for times.",
    )
    parser.add_argument(
        "recording", type=Path, metavar="SEQUENCE", help="folder or file of a recording"
    )
    parser.add_argument("--map", type=Path, metavar="MAP", help="map folder to localise in")
    parser.add_argument(
        "--out",
        type=Path,
        required=True,
        metavar="RUN",
        help="folder to write; an earlier run there is replaced as a whole",
    )
    parser.add_argument(
        "--frames", type=span, metavar="A:B", help="play frames A to B - 1 of the recording only"
    )
    parser.add_argument("--stride", type=positive, default=1, metavar="K", help="every K-th frame")
    parser.add_argument("--reverse", action="store_true", help="play backwards")
    parser.add_argument("--config", type=Path, metavar="FILE", help="settings (TOML)")
    parser.add_argument(
        "--segmenter",
        type=Path,
        metavar="MODEL.onnx",
        help="look for changes with this model; the map must have been built with it, too",
    )
    parser.add_argument(
        "--realtime", action="store_true", help="play at the recorded times and publish live"
    )
    parser.set_defaults(run="edge.runtime.commands:replay")


def _add_localise(commands: Commands) -> None:
    parser = commands.add_parser(
        "localise",
        help="find single images in a map",
        description="Find each image alone in a map; one line of JSON for each.",
    )
    parser.add_argument("map", type=Path, metavar="MAP", help="map folder")
    parser.add_argument("images", type=Path, nargs="+", metavar="IMAGE", help="image file")
    parser.add_argument(
        "--camera",
        type=Path,
        required=True,
        metavar="camera.toml",
        help="calibration of the images",
    )
    parser.add_argument("--config", type=Path, metavar="FILE", help="settings (TOML)")
    parser.add_argument(
        "--out",
        type=Path,
        metavar="fixes.jsonl",
        help="file instead of stdout; earlier fixes give way",
    )
    parser.set_defaults(run="edge.runtime.commands:localise")


def _add_plot(commands: Commands) -> None:
    parser = commands.add_parser(
        "plot",
        help="draw a run",
        description="Draw a run's path from above, its error and its states as a PNG picture.",
    )
    parser.add_argument("run_folder", type=Path, metavar="RUN", help="folder written by replay")
    parser.add_argument("--map", type=Path, metavar="MAP", help="map folder to draw beneath")
    parser.add_argument(
        "--truth", type=Path, metavar="TRUTH", help="recording or TUM file with the true poses"
    )
    parser.add_argument(
        "--out", type=picture, metavar="FILE.png", help="picture to write (default: RUN/plot.png)"
    )
    parser.set_defaults(run="edge.runtime.commands:plot")
