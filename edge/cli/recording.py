# SPDX-License-Identifier: Apache-2.0
"""Commands that keep what a camera saw."""

from pathlib import Path

from edge.cli.command_line import Commands, ending_in, positive, positive_number, span


def add(commands: Commands) -> None:
    """Add `record` and `recover`."""
    parser = commands.add_parser(
        "record",
        help="record the camera into one file",
        description="Record the camera of the settings, or another recording, into one file "
        "(MCAP) that `mapvo replay` plays. Ctrl-C ends it; after a kill, `mapvo recover` mends it.",
    )
    parser.add_argument(
        "recording",
        type=Path,
        nargs="?",
        metavar="SEQUENCE",
        help="recording to convert, instead of the camera of the settings",
    )
    parser.add_argument("--config", type=Path, metavar="FILE", help="settings (TOML)")
    parser.add_argument(
        "--out",
        type=ending_in(".mcap"),
        required=True,
        metavar="FILE.mcap",
        help="file to write",
    )
    parser.add_argument("--frames", type=span, metavar="A:B", help="of SEQUENCE: frames A to B - 1")
    parser.add_argument(
        "--stride", type=positive, default=1, metavar="K", help="every K-th of them"
    )
    parser.add_argument("--count", type=positive, metavar="N", help="end after N frames")
    parser.add_argument("--seconds", type=positive_number, metavar="S", help="end after S seconds")
    parser.add_argument(
        "--images", choices=("png", "raw"), default="png", help="raw: quicker, larger"
    )
    parser.add_argument(
        "--uncalibrated",
        action="store_true",
        help="record for `mapvo calibrate`; so it is where the settings name no calibration",
    )
    parser.set_defaults(run="edge.runtime.recording_commands:record")

    parser = commands.add_parser(
        "recover",
        help="mend recordings that were cut off",
        description="Make recording files whole, in place, that a kill, a power cut or a full disk "
        "cut off. Whole ones stay as they are.",
    )
    parser.add_argument("files", type=Path, nargs="+", metavar="FILE.mcap", help="recording file")
    parser.set_defaults(run="edge.runtime.recording_commands:recover")
