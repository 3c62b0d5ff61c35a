# SPDX-License-Identifier: Apache-2.0
"""The command `mapvo`: what it understands, and how it speaks when something is wrong.

Nothing heavy is imported before a command is known, so that help comes at once.
"""

import argparse
import logging
import os
import signal
import sys
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from types import FrameType
from typing import NoReturn

from edge import __version__
from edge.errors import EdgeError

USER_ERROR = 2
INTERRUPTED = 130  # as shells count Ctrl-C


class _Parser(argparse.ArgumentParser):
    """Says what is wrong in one line."""

    def error(self, message: str) -> NoReturn:
        self.exit(USER_ERROR, f"{self.prog}: {message}; see `{self.prog} --help`\n")


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; return the exit status."""
    args = _parser().parse_args(argv)
    logging.basicConfig(
        level=logging.INFO if args.verbose else logging.WARNING,
        format="%(levelname)s %(name)s %(message)s",
    )
    _one_thread_each()
    signal.signal(signal.SIGTERM, _interrupt)
    try:
        module, _, function = args.run.partition(":")
        status: int = getattr(import_module(module), function)(args)
        sys.stdout.flush()
    except EdgeError as error:
        print(f"mapvo: {error}", file=sys.stderr)
        return USER_ERROR
    except KeyboardInterrupt:
        print("mapvo: interrupted", file=sys.stderr)
        return INTERRUPTED
    except BrokenPipeError:
        # Who reads our output has seen enough; Python must not try to flush the rest at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    return status


def _interrupt(_number: int, _frame: FrameType | None) -> None:
    """Let SIGTERM clean up as Ctrl-C does."""
    raise KeyboardInterrupt


def _one_thread_each() -> None:
    """Keep BLAS and OpenMP from making threads: the cores belong to the pipeline's own."""
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")


def _parser() -> _Parser:
    parser = _Parser(
        prog="mapvo",
        description="Tells a single moving camera where it is on a map made beforehand.",
        allow_abbrev=False,
    )
    parser.add_argument("--version", action="version", version=f"mapvo {__version__}")
    parser.add_argument("-v", "--verbose", action="store_true", help="log changes of state")
    commands = parser.add_subparsers(
        metavar="COMMAND", required=True, parser_class=_Parser, dest="command"
    )
    _add_replay(commands)
    _add_localise(commands)
    _add_plot(commands)
    _add_settings(commands)
    return parser


def _add_replay(commands: "argparse._SubParsersAction[_Parser]") -> None:
    parser = commands.add_parser(
        "replay",
        help="run the pipeline on a recording",
        description="Run the whole pipeline on a recording and write a run folder. Without "
        "--realtime the same input gives the same files, byte for byte but for times.",
        allow_abbrev=False,
    )
    parser.add_argument("recording", type=Path, metavar="SEQUENCE", help="folder of a recording")
    parser.add_argument("--map", type=Path, metavar="MAP", help="map folder to localise in")
    parser.add_argument("--out", type=Path, required=True, metavar="RUN", help="folder to write")
    parser.add_argument(
        "--frames", type=_span, metavar="A:B", help="play frames A to B - 1 of the recording only"
    )
    parser.add_argument("--stride", type=_positive, default=1, metavar="K", help="every K-th frame")
    parser.add_argument("--reverse", action="store_true", help="play backwards")
    parser.add_argument("--config", type=Path, metavar="FILE", help="settings (TOML)")
    parser.add_argument(
        "--realtime", action="store_true", help="play at the recorded times and publish live"
    )
    parser.set_defaults(run="edge.runtime.commands:replay")


def _add_localise(commands: "argparse._SubParsersAction[_Parser]") -> None:
    parser = commands.add_parser(
        "localise",
        help="find single images in a map",
        description="Find each image alone in a map; one line of JSON for each.",
        allow_abbrev=False,
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
    parser.add_argument("--out", type=Path, metavar="fixes.jsonl", help="file instead of stdout")
    parser.set_defaults(run="edge.runtime.commands:localise")


def _add_plot(commands: "argparse._SubParsersAction[_Parser]") -> None:
    parser = commands.add_parser(
        "plot",
        help="draw a run",
        description="Draw a run's path from above, its error and its states as a PNG picture.",
        allow_abbrev=False,
    )
    parser.add_argument("run_folder", type=Path, metavar="RUN", help="folder written by replay")
    parser.add_argument("--map", type=Path, metavar="MAP", help="map folder to draw beneath")
    parser.add_argument(
        "--truth", type=Path, metavar="TRUTH", help="recording or TUM file with the true poses"
    )
    parser.add_argument(
        "--out", type=Path, metavar="FILE.png", help="picture to write (default: RUN/plot.png)"
    )
    parser.set_defaults(run="edge.runtime.commands:plot")


def _add_settings(commands: "argparse._SubParsersAction[_Parser]") -> None:
    parser = commands.add_parser(
        "warm-up",
        help="compile all kernels beforehand",
        description="Compile all kernels into the cache, so that no run waits for it.",
        allow_abbrev=False,
    )
    parser.add_argument("--config", type=Path, metavar="FILE", help="settings (TOML)")
    parser.set_defaults(run="edge.runtime.commands:warm_up")

    parser = commands.add_parser(
        "check-config", help="check a configuration file", allow_abbrev=False
    )
    parser.add_argument("file", type=Path, metavar="FILE", help="settings (TOML)")
    parser.set_defaults(run="edge.runtime.commands:check_config")

    parser = commands.add_parser(
        "config", help="print all settings with their reasons", allow_abbrev=False
    )
    parser.add_argument(
        "--defaults", action="store_true", required=True, help="print the defaults as TOML"
    )
    parser.set_defaults(run="edge.runtime.commands:print_defaults")


def _span(text: str) -> slice:
    """`A:B`, either end may be left out."""
    parts = text.split(":")
    if len(parts) != 2 or not all(
        part == "" or (part.isascii() and part.isdigit()) for part in parts
    ):
        raise argparse.ArgumentTypeError(f"{text!r} is no A:B of two frame numbers")
    begin, end = (int(part) if part else None for part in parts)
    if begin is not None and end is not None and begin >= end:
        raise argparse.ArgumentTypeError(f"{text!r} holds no frame: A must be below B")
    return slice(begin, end)


def _positive(text: str) -> int:
    if not (text.isascii() and text.isdigit() and int(text) > 0):
        raise argparse.ArgumentTypeError(f"{text!r} is no whole number above 0")
    return int(text)


if __name__ == "__main__":
    sys.exit(main())
