# SPDX-License-Identifier: Apache-2.0
"""The command mapvo-map."""

import argparse
import logging
import os
import signal
import sys
from collections.abc import Sequence
from pathlib import Path
from types import FrameType
from typing import NoReturn

from edge.errors import EdgeError
from edge.runtime.kernel_cache import use_kernel_cache


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; 0 if all went well, 2 with one line on stderr if not."""
    arguments = _parser().parse_args(argv)
    logging.basicConfig(format="%(levelname)s %(message)s", level=logging.WARNING)
    # Threads and processes of our own share the cores, and sums keep their order.
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    use_kernel_cache()
    signal.signal(signal.SIGTERM, _stop)
    try:
        arguments.run(arguments)
        sys.stdout.flush()
    except EdgeError as error:
        print(f"mapvo-map: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("mapvo-map: stopped; nothing was written", file=sys.stderr)
        return 130
    except BrokenPipeError:
        # Who reads our output has seen enough; Python must not try to flush the rest at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    return 0


def _stop(_number: int, _frame: FrameType | None) -> None:
    raise KeyboardInterrupt


class _Parser(argparse.ArgumentParser):
    """Says what is wrong in one line."""

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: {message}; see {self.prog} --help\n")


def _parser() -> argparse.ArgumentParser:
    parser = _Parser("mapvo-map", description="Compile, look into and check maps.")
    commands = parser.add_subparsers(dest="command", required=True)
    _add_build(commands.add_parser("build", help="compile a map from posed images"))
    inspect = commands.add_parser("inspect", help="say what a map holds")
    inspect.set_defaults(run=_inspect)
    inspect.add_argument("map", type=Path)
    inspect.add_argument("--picture", type=Path, metavar="FILE.png", help="draw it from two sides")
    verify = commands.add_parser("verify", help="check every byte of a map")
    verify.set_defaults(run=_verify)
    verify.add_argument("map", type=Path)
    verify.add_argument(
        "--public-key", type=Path, metavar="FILE", help="and that it was signed with this key"
    )
    sign = commands.add_parser("sign", help="sign a map, so that devices can trust it")
    sign.set_defaults(run=_sign)
    sign.add_argument("map", type=Path)
    sign.add_argument(
        "--key", type=Path, required=True, metavar="FILE", help="Ed25519 private key (PEM)"
    )
    return parser


def _add_build(parser: argparse.ArgumentParser) -> None:
    parser.set_defaults(run=_build)
    parser.add_argument("sequences", type=Path, nargs="+", metavar="SEQUENCE")
    parser.add_argument("--out", type=Path, required=True, metavar="MAP")
    parser.add_argument("--frames", type=_span, metavar="A:B", help="half-open range of images")
    parser.add_argument("--every", type=_count, default=1, metavar="K", help="take each K-th")
    parser.add_argument(
        "--exclude",
        type=_indices,
        default=frozenset(),
        metavar="I,J,...",
        help="images to leave out",
    )
    parser.add_argument("--poses", choices=["given"], default="given", help="from groundtruth.txt")
    parser.add_argument(
        "--depth",
        choices=["none", "given", "stereo"],
        default="given",
        help="given: depth images where there are some (default); stereo: from the right camera",
    )
    parser.add_argument("--tile-m", type=_length, default=None, metavar="M", help="side of a tile")
    parser.add_argument("--workers", type=_count, default=1, metavar="N", help="processes")


def _build(arguments: argparse.Namespace) -> None:
    # Imported here, as OpenCV and Numba take a second that `--help` need not wait for.
    from maps.build import BuildInput, build
    from maps.settings import BuildSettings

    settings = BuildSettings(depth=arguments.depth)
    if arguments.tile_m is not None:
        settings = BuildSettings(depth=arguments.depth, tile_m=arguments.tile_m)
    source = BuildInput(arguments.sequences, arguments.frames, arguments.every, arguments.exclude)
    report = build(source, arguments.out, settings, workers=arguments.workers)
    counts = report.manifest.counts
    size = sum(tile.bytes for tile in report.manifest.tiles)
    print(
        f"{arguments.out}: {counts.keyframes} keyframes, {counts.points} points seen "
        f"{report.views_per_point:.1f} times each, median residual "
        f"{report.median_residual_px:.2f} px, {size / 1e6:.1f} MB "
        f"({size / counts.keyframes / 1e3:.0f} kB a keyframe) in {len(report.manifest.tiles)} tiles"
    )
    if report.skipped:
        print(f"{report.skipped} images have no pose and were left out")


def _inspect(arguments: argparse.Namespace) -> None:
    from maps.inspection import draw, table

    print(table(arguments.map))
    if arguments.picture is not None:
        draw(arguments.map, arguments.picture)
        print(f"picture: {arguments.picture}")


def _verify(arguments: argparse.Namespace) -> None:
    from maps.verification import verify

    checked = verify(arguments.map)
    signed = ""
    if arguments.public_key is not None:
        from maps.signing import check_signature

        check_signature(arguments.map, arguments.public_key)
        signed = ", signed with this key"
    size = f"{checked.bytes / 1e6:.1f} MB"
    print(f"OK: {checked.tiles} tiles, {size}, {checked.points} points{signed}")


def _sign(arguments: argparse.Namespace) -> None:
    from maps.signing import sign

    print(f"{sign(arguments.map, arguments.key)}: written")


def _span(text: str) -> slice:
    start, separator, stop = text.partition(":")
    try:
        span = slice(int(start) if start else None, int(stop) if stop else None)
    except ValueError:
        separator = ""
    if not separator or min(span.start or 0, span.stop or 0) < 0:
        raise argparse.ArgumentTypeError(f"{text!r} is no range A:B of indices from 0 on")
    return span


def _count(text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is no whole number from 1 on")
    return int(text)


def _indices(text: str) -> frozenset[int]:
    parts = [part for part in text.split(",") if part]
    if not all(part.isdecimal() for part in parts):
        raise argparse.ArgumentTypeError(f"{text!r} is no list of indices I,J,...")
    return frozenset(int(part) for part in parts)


def _length(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0.1 <= value <= 1e6:
        raise argparse.ArgumentTypeError(f"{text!r} is no length from 0.1 to 1000000")
    return value


if __name__ == "__main__":
    sys.exit(main())
