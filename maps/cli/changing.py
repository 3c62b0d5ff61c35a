# SPDX-License-Identifier: Apache-2.0
"""Commands that place, join and thin maps."""

import argparse
import re
from pathlib import Path

from edge.cli.command_line import Commands, positive

_OUT = "folder to write; an earlier map there is replaced as a whole, but for those that are read"


def add(commands: Commands) -> None:
    """Add `align`, `merge` and `thin`."""
    align = commands.add_parser(
        "align",
        help="level and place a map",
        description="Level a map, z up, and place it, as autopilots need it: by a direction, by "
        "surveyed points or by a square marker. The map's own frame and poses stay as they are.",
    )
    align.set_defaults(run=_align)
    align.add_argument("map", type=Path, metavar="MAP")
    # So that "--up -1,0,0" is no option "-1,0,0": argparse knows single numbers only.
    align._negative_number_matcher = re.compile(r"^-[\d.eE,+-]+$")
    how = align.add_mutually_exclusive_group(required=True)
    how.add_argument("--up", type=_vector, metavar="X,Y,Z", help="direction in the map that is up")
    how.add_argument(
        "--points",
        type=Path,
        metavar="FILE",
        help="surveyed points: lines 'X Y Z at x y z' (the map's), or 'X Y Z in IMAGE u v'",
    )
    how.add_argument("--marker", type=_number, metavar="ID", help="square marker at the origin")
    align.add_argument(
        "--family", default="APRILTAG_36H11", metavar="NAME", help="of the marker (%(default)s)"
    )
    align.add_argument(
        "--on", choices=["floor", "wall"], default="floor", help="where it is (floor)"
    )
    align.add_argument(
        "--images",
        type=Path,
        nargs="+",
        default=[],
        metavar="SEQUENCE",
        help="what the map was built from (default: by name, here or beside the map)",
    )
    merge = commands.add_parser(
        "merge",
        help="join two maps of one frame",
        description="Join two maps whose poses share one frame; points that both have become one.",
    )
    merge.set_defaults(run=_merge)
    merge.add_argument("maps", type=Path, nargs=2, metavar="MAP")
    merge.add_argument("--out", type=Path, required=True, metavar="MAP", help=_OUT)
    thin = commands.add_parser(
        "thin",
        help="drop keyframes that add no coverage",
        description="Write a smaller map, without keyframes whose points others see as well.",
    )
    thin.set_defaults(run=_thin)
    thin.add_argument("map", type=Path, metavar="MAP")
    thin.add_argument("--out", type=Path, required=True, metavar="MAP", help=_OUT)
    thin.add_argument(
        "--share",
        type=_share,
        default=0.9,
        metavar="S",
        help="of its points that others see, for a keyframe to go (%(default)s)",
    )
    thin.add_argument(
        "--others", type=positive, default=2, metavar="N", help="how many others (%(default)s)"
    )


def _align(arguments: argparse.Namespace) -> None:
    import numpy as np

    from edge.tiles.reader import open_map
    from maps import align

    opened = open_map(arguments.map)
    if arguments.up is not None:
        found = align.by_up(np.array(arguments.up))
    elif arguments.points is not None:
        found = align.by_points(opened, arguments.points)
    else:
        found = align.by_marker(
            opened,
            arguments.marker,
            arguments.family,
            on_wall=arguments.on == "wall",
            recordings=arguments.images,
        )
    dropped = align.write_alignment(arguments.map, found)
    print(f"{arguments.map}: aligned by {found.how}")
    if dropped:
        _say_unsigned(arguments.map)


def _merge(arguments: argparse.Namespace) -> None:
    from edge.errors import TileError
    from maps.merge import merge
    from maps.writer import is_map

    signed, replaces = _is_signed(arguments.out), is_map(arguments.out)
    if arguments.maps[0].resolve() == arguments.maps[1].resolve():
        raise TileError(f"{arguments.maps[0]}: is named twice; name two maps")
    manifest, overlap = merge(arguments.maps[0], arguments.maps[1], arguments.out)
    counts = manifest.counts
    print(
        f"{arguments.out}: {counts.keyframes} keyframes, {counts.points} points"
        + ("; the earlier map there is gone" if replaces else "")
    )
    if overlap.places:
        print(
            f"{overlap.agreeing} of {overlap.places} places that both show lie together; "
            f"{overlap.points} points that both have are one now"
        )
    else:
        print("no place is in both maps: whether they share one frame was not checked")
    if signed:
        _say_unsigned(arguments.out)


def _thin(arguments: argparse.Namespace) -> None:
    from edge.tiles.reader import read_manifest
    from maps.thin import thin
    from maps.writer import is_map

    before, replaces = read_manifest(arguments.map), is_map(arguments.out)
    signed = _is_signed(arguments.map) or _is_signed(arguments.out)
    after = thin(arguments.map, arguments.out, arguments.share, arguments.others)
    sizes = [sum(tile.bytes for tile in each.tiles) / 1e6 for each in (before, after)]
    print(
        f"{arguments.out}: {after.counts.keyframes} of {before.counts.keyframes} keyframes, "
        f"{after.counts.points} of {before.counts.points} points, "
        f"{sizes[1]:.1f} of {sizes[0]:.1f} MB"
        + ("; the earlier map there is gone" if replaces else "")
    )
    if signed:
        _say_unsigned(arguments.out)


def _is_signed(folder: Path) -> bool:
    from maps.align import SIGNATURE_NAME

    return (folder / SIGNATURE_NAME).exists()


def _say_unsigned(folder: Path) -> None:
    print(f"its signature is void and gone: sign it again with mapvo-map sign {folder} --key FILE")


def _vector(text: str) -> tuple[float, ...]:
    try:
        values = tuple(float(part) for part in text.split(","))
    except ValueError:
        values = ()
    if len(values) != 3:
        raise argparse.ArgumentTypeError(f"{text!r} is no direction X,Y,Z")
    return values


def _number(text: str) -> int:
    if not (text.isascii() and text.isdigit()):
        raise argparse.ArgumentTypeError(f"{text!r} is no marker's number")
    return int(text)


def _share(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0.0 < value <= 1.0:
        raise argparse.ArgumentTypeError(f"{text!r} is no share above 0 and up to 1")
    return value
