# SPDX-License-Identifier: Apache-2.0
"""Commands that send maps to devices: bundles, and the keys that sign them."""

import argparse
import re
from datetime import UTC, datetime
from pathlib import Path

from edge.cli.command_line import Commands, Parser, ending_in, positive


def add(commands: Commands) -> None:
    """Add `bundle` and `key`."""
    _add_bundle(commands)
    key = commands.add_parser("key", help="make and change the keys that devices trust")
    kinds = key.add_subparsers(metavar="COMMAND", required=True, parser_class=Parser)
    new = kinds.add_parser("new", help="make a private key, and the public one beside it")
    new.set_defaults(run=_new_key)
    new.add_argument("key", type=Path, metavar="FILE", help="private key to write")
    rotate = kinds.add_parser(
        "rotate", help="let devices trust a new key because the old one says so"
    )
    rotate.set_defaults(run=_rotate)
    rotate.add_argument("old", type=Path, metavar="OLD", help="private key that is trusted now")
    rotate.add_argument("new", type=Path, metavar="NEW", help="private key to be trusted")
    rotate.add_argument(
        "--retire", action="store_true", help="and the old one is trusted no longer"
    )


def _add_bundle(commands: Commands) -> None:
    parser = commands.add_parser("bundle", help="put a map into one signed file for devices")
    parser.set_defaults(run=_bundle)
    parser.add_argument("map", type=Path, metavar="MAP")
    parser.add_argument("--key", type=Path, required=True, metavar="FILE", help="private key (PEM)")
    parser.add_argument(
        "--out", type=ending_in(".mapbundle"), required=True, metavar="FILE.mapbundle"
    )
    parser.add_argument(
        "--site", type=_site, default="site", metavar="NAME", help="where it is for"
    )
    parser.add_argument(
        "--map-version",
        type=positive,
        metavar="N",
        help="rises from bundle to bundle of a site (default: the time, YYYYMMDDhhmmss)",
    )
    parser.add_argument(
        "--base", type=Path, metavar="MAP", help="leave out tiles that this map has already"
    )
    parser.add_argument(
        "--camera",
        type=Path,
        action="append",
        default=[],
        metavar="camera.toml",
        help="only for devices of this calibration; may be given several times",
    )
    parser.add_argument(
        "--expires", type=_date, metavar="YYYY-MM-DD", help="not to be installed from then on"
    )
    parser.add_argument(
        "--untested", action="store_true", help="without a self-test, for maps too small for it"
    )


def _bundle(arguments: argparse.Namespace) -> None:
    from maps.bundle import BundleOrder, bundle

    order = BundleOrder(
        site=arguments.site,
        map_version=arguments.map_version,
        expires=arguments.expires,
        cameras=arguments.camera,
        base=arguments.base,
        untested=arguments.untested,
    )
    made = bundle(arguments.map, arguments.key, arguments.out, order)
    carried = sum(entry.carried for entry in made.header.files)
    held_out = made.held_out
    print(
        f"{arguments.out}: site {made.header.site}, version {made.header.map_version}, "
        f"{made.bytes / 1e6:.1f} MB, {carried} of {len(made.header.files)} files carried, "
        + (
            f"{held_out.found} of {held_out.tried} held-out keyframes found"
            if held_out.tried
            else "not tested"
        )
    )


def _new_key(arguments: argparse.Namespace) -> None:
    from maps.bundle_keys import make_key

    made = make_key(arguments.key)
    print(f"{made.private}: keep it secret; {made.public}: put it on the devices; id {made.id}")


def _rotate(arguments: argparse.Namespace) -> None:
    from maps.bundle_keys import rotate_key

    out = rotate_key(arguments.old, arguments.new, arguments.retire)
    print(f"{out}: bring it to the devices as a bundle is brought")


def _site(text: str) -> str:
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}", text):
        raise argparse.ArgumentTypeError(f"{text!r} is not up to 64 letters, digits and . _ -")
    return text


def _date(text: str) -> datetime:
    try:
        return datetime.fromisoformat(text).replace(tzinfo=UTC)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is no date YYYY-MM-DD") from None
