# SPDX-License-Identifier: Apache-2.0
"""The command `mapvo`: what it understands, and how it speaks when something is wrong.

Nothing heavy is imported before a command is known, so that help comes at once.
"""

import logging
from collections.abc import Sequence
from importlib import import_module

from edge import __version__
from edge.cli import calibrating, health, models, playing, recording, running, settings, tiles
from edge.cli.command_line import Parser, finish, one_thread_each

GROUPS = (playing, settings, recording, calibrating, health, models, running, tiles)


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; return the exit status."""
    args = _parser().parse_args(argv)
    logging.basicConfig(
        level=logging.INFO if args.verbose else logging.WARNING,
        format="%(levelname)s %(name)s %(message)s",
    )
    one_thread_each()

    def work() -> int:
        module, _, function = args.run.partition(":")
        status: int = getattr(import_module(module), function)(args)
        return status

    return finish("mapvo", "interrupted", work)


def _parser() -> Parser:
    parser = Parser(
        prog="mapvo",
        description="Tells a single moving camera where it is on a map made beforehand. Maps are "
        "made by mapvo-map.",
    )
    parser.add_argument("--version", action="version", version=f"mapvo {__version__}")
    parser.add_argument("-v", "--verbose", action="store_true", help="log changes of state")
    commands = parser.add_subparsers(
        metavar="COMMAND", required=True, parser_class=Parser, dest="command"
    )
    for group in GROUPS:
        group.add(commands)
    return parser
