# SPDX-License-Identifier: Apache-2.0
"""The command `mapvo-map`."""

import logging
from collections.abc import Sequence

from edge import __version__
from edge.cli.command_line import Parser, finish, one_thread_each
from edge.runtime.kernel_cache import use_kernel_cache
from maps.cli import building, bundling, changing, checking

GROUPS = (building, checking, bundling, changing)


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; 0 if all went well, 2 with one line on stderr if not."""
    parser = Parser(
        "mapvo-map",
        description="Compile, look into, change and check maps, and send them to devices, whose "
        "command is mapvo.",
    )
    parser.add_argument("--version", action="version", version=f"mapvo-map {__version__}")
    commands = parser.add_subparsers(
        metavar="COMMAND", required=True, parser_class=Parser, dest="command"
    )
    for group in GROUPS:
        group.add(commands)
    arguments = parser.parse_args(argv)
    logging.basicConfig(format="%(levelname)s %(message)s", level=logging.WARNING)
    one_thread_each()
    use_kernel_cache()

    def work() -> int:
        arguments.run(arguments)
        return 0

    return finish("mapvo-map", "stopped; the same command goes on from here", work)
