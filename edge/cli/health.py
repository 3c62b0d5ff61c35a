# SPDX-License-Identifier: Apache-2.0
"""Commands that say what is wrong."""

from pathlib import Path

from edge.cli.command_line import Commands, Parser, ending_in


def add(commands: Commands) -> None:
    """Add `doctor` and `support`."""
    parser = commands.add_parser(
        "doctor",
        help="look for what will not work, and say what to do",
        description="Look at camera, calibration, map, serial line, clock, processor, heat, "
        "supply, memory, disk and compiled kernels: a line each, with a remedy where one is "
        "needed. Exit status 1 where something will not work.",
    )
    _add_common(parser)
    parser.add_argument(
        "--look",
        action="store_true",
        help="look through the camera, too: rate, age of the images, light, sharpness",
    )
    parser.set_defaults(run="edge.runtime.health_commands:doctor")

    parser = commands.add_parser(
        "support",
        help="pack everything that helps to help into one file",
        description="Pack the doctor's findings, versions, settings, log and the map's manifest "
        "into one file. Keys, names and, without --recording, images stay out of it.",
    )
    _add_common(parser)
    parser.add_argument(
        "--out",
        type=ending_in(".tar.gz"),
        required=True,
        metavar="FILE.tar.gz",
        help="file to write",
    )
    parser.add_argument(
        "--recording", action="store_true", help="with the newest recording: it holds images"
    )
    parser.set_defaults(run="edge.runtime.health_commands:support")


def _add_common(parser: Parser) -> None:
    parser.add_argument("--config", type=Path, metavar="FILE", help="settings (TOML)")
    parser.add_argument(
        "--root",
        type=Path,
        default=Path("/"),
        metavar="FOLDER",
        help="look at the system below a folder, an image's for example",
    )
