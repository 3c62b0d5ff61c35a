# SPDX-License-Identifier: Apache-2.0
"""Commands about the user's models."""

from pathlib import Path

from edge.cli.command_line import Commands, Parser, picture


def add(commands: Commands) -> None:
    """Add `model` and what belongs to it."""
    models = commands.add_parser(
        "model",
        help="look at a model before it is used",
        description="Look at a model (ONNX) of instance segmentation or of features before it is "
        "used.",
    )
    kinds = models.add_subparsers(
        metavar="COMMAND", required=True, parser_class=Parser, dest="model_command"
    )
    check = kinds.add_parser(
        "check",
        help="say how a model is understood, and try it",
        description="Say what a model expects and gives, run it in a process of its own as it "
        "would run live, and draw what it sees in an image; what is no model of segmentation is "
        "tried as one of features. A file MODEL.onnx.toml beside it "
        "says what cannot be known from it.",
    )
    check.add_argument("model", type=Path, metavar="MODEL.onnx")
    check.add_argument("image", type=Path, nargs="?", metavar="IMAGE", help="image to try it on")
    check.add_argument(
        "--out", type=picture, metavar="FILE.png", help="picture (default: ./IMAGE-masks.png)"
    )
    check.set_defaults(run="edge.runtime.model_commands:check")
