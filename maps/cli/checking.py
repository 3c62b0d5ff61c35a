# SPDX-License-Identifier: Apache-2.0
"""Commands that look into maps, check and sign them."""

import argparse
from pathlib import Path

from edge.cli.command_line import Commands, picture


def add(commands: Commands) -> None:
    """Add `inspect`, `verify` and `sign`."""
    inspect = commands.add_parser(
        "inspect",
        help="say what a map holds",
        description="Say what a map holds, how good its points are and what takes how much.",
    )
    inspect.set_defaults(run=_inspect)
    inspect.add_argument("map", type=Path, metavar="MAP")
    inspect.add_argument(
        "--picture", type=picture, metavar="FILE.png", help="draw it from two sides"
    )
    verify = commands.add_parser(
        "verify",
        help="check every byte of a map",
        description="Check every byte of a map, and every reference within it.",
    )
    verify.set_defaults(run=_verify)
    verify.add_argument("map", type=Path, metavar="MAP")
    verify.add_argument(
        "--public-key", type=Path, metavar="FILE", help="and that it was signed with this key"
    )
    sign = commands.add_parser(
        "sign",
        help="sign a map folder",
        description="Write a signature into a map folder, for `mapvo-map verify --public-key`. "
        "Devices take bundles (`mapvo-map bundle`), which are signed as well.",
    )
    sign.set_defaults(run=_sign)
    sign.add_argument("map", type=Path, metavar="MAP")
    sign.add_argument(
        "--key", type=Path, required=True, metavar="FILE", help="Ed25519 private key (PEM)"
    )


def _inspect(arguments: argparse.Namespace) -> None:
    from maps.inspection import table
    from maps.picture import draw

    text = table(arguments.map)
    if arguments.picture is not None:
        draw(arguments.map, arguments.picture)
        text += f"\npicture: {arguments.picture}"
    print(text)


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
