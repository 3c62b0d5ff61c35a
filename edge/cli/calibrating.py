# SPDX-License-Identifier: Apache-2.0
"""Commands that find out what a camera's lens does."""

import argparse
import re
from pathlib import Path

from edge.cli.command_line import Commands, Parser, picture, positive_number


def add(commands: Commands) -> None:
    """Add `calibrate` and `board`."""
    parser = commands.add_parser(
        "calibrate",
        help="calibrate a camera by a printed board",
        description="Calibrate a camera from images or a recording of a ChArUco board (`mapvo "
        "board` draws one). Bring it into all parts of the image, tilted to all sides.",
    )
    parser.add_argument(
        "images", type=Path, nargs="+", metavar="IMAGE", help="images, their folder or a recording"
    )
    _add_board(parser)
    parser.add_argument(
        "--model",
        choices=("auto", "radtan", "equidistant"),
        default="auto",
        help="lens model; auto takes the one that fits views better which it was not made from",
    )
    parser.add_argument("--identity", metavar="ID", help="camera that it holds for")
    parser.add_argument("--rate-hz", type=positive_number, metavar="HZ", help="its frame rate")
    parser.add_argument(
        "--out", type=Path, required=True, metavar="camera.toml", help="file to write"
    )
    parser.add_argument("--picture", type=picture, metavar="FILE.png", help="default: beside --out")
    parser.set_defaults(run="edge.runtime.calibration_commands:calibrate")

    parser = commands.add_parser(
        "board",
        help="draw a board to calibrate with",
        description="Draw a ChArUco board to be printed.",
    )
    _add_board(parser)
    parser.add_argument(
        "--out", type=picture, required=True, metavar="FILE.png", help="picture to write"
    )
    parser.set_defaults(run="edge.runtime.calibration_commands:draw_board")


def _add_board(parser: Parser) -> None:
    parser.add_argument(
        "--board", type=_size, default=(9, 6), metavar="CxR", help="squares (default: 9x6)"
    )
    parser.add_argument(
        "--square",
        type=positive_number,
        default=0.03,
        metavar="M",
        help="side of one (default: 0.03)",
    )
    parser.add_argument(
        "--marker",
        type=positive_number,
        metavar="M",
        help="of a marker (default: 3/4 of the square's)",
    )
    parser.add_argument(
        "--dictionary", default="DICT_4X4_50", metavar="NAME", help="default: DICT_4X4_50"
    )


def _size(text: str) -> tuple[int, int]:
    match = re.fullmatch(r"(\d{1,2})x(\d{1,2})", text)
    if match is None or min(int(match[1]), int(match[2])) < 3:
        raise argparse.ArgumentTypeError(f"{text!r} is no board size CxR of 3 squares and more")
    return int(match[1]), int(match[2])
